"""What reads somebody's macros and MJCF, run as a script: in a process of its own, with limits.

Standard library only, since it starts once for every file: `confined.py` runs it. The words behind
it are what to do, the file, the limits (seconds of computing, bytes of memory and of output) and
the file's arguments, NAME:=VALUE. It prints a line with notes as a JSON list, then what came out,
and ends with 0; or prints a reason and ends with `REFUSED`.
"""

from __future__ import annotations

import ast
import contextlib
import json
import math
import operator
import os
import re
import sys
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

REFUSED = 3
"""How the process ends if the file is refused."""

PLAIN = (bool, int, float, str, list, tuple, dict, set, type(None))
"""Values that an expression may hold."""

OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.Not: operator.not_,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.In: lambda one, many: one in many,
    ast.NotIn: lambda one, many: one not in many,
    ast.Is: lambda one, other: one is other,
    ast.IsNot: lambda one, other: one is not other,
}

FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: f for name, f in vars(math).items() if name[0] != "_" and callable(f)},
    **{f.__name__: f for f in (abs, all, any, bool, float, int, len, max, min, round, str, sum)},
    **{f.__name__: f for f in (dict, list, set, sorted, tuple)},
    "enumerate": lambda values: list(enumerate(values)),
    "range": lambda *ends: list(range(*ends)),
    "zip": lambda *columns: list(zip(*columns, strict=False)),
}

TYPES = {kind.__name__: kind for kind in PLAIN[:-1]}
"""Types that an expression may ask for by `isinstance`."""

METHODS: dict[type, tuple[str, ...]] = {
    str: (
        *("startswith", "endswith", "lower", "upper", "title", "capitalize", "strip", "lstrip"),
        *("rstrip", "removeprefix", "removesuffix", "replace", "split", "rsplit", "partition"),
        *("rpartition", "join", "find", "rfind", "index", "count", "isdigit", "isalpha"),
    ),
    dict: ("get", "keys", "values", "items"),
    list: ("index", "count"),
    tuple: ("index", "count"),
    set: ("union", "intersection", "difference", "issubset", "issuperset"),
}
"""Methods that an expression may call, by the type of their object."""

SCOPES = ("math", "python", "xacro")
"""Before the name of a function."""

FORBIDDEN = (
    *("exec", "import", "os.", "shutil.", "subprocess.", "socket.", "ctypes.", "pty.", "fcntl."),
    *("mmap.", "pickle.", "marshal.", "code.", "function.", "sqlite3.", "urllib.", "webbrowser."),
)
"""Beginnings of what Python reports before it does it, once macros are expanded."""

NUMBERS = (
    *("body_pos", "body_quat", "jnt_pos", "jnt_axis", "qpos0", "eq_data", "wrap_prm", "mesh_vert"),
    *("geom_pos", "geom_quat", "geom_size"),
)
"""Of MuJoCo's model, those a robot is made of."""

LARGEST = 1e6
"""None of them is larger."""

NOTES = 100
"""Maximum number of notes."""

UNKNOWN = "Caught an unknown exception"
"""MuJoCo's words for having no memory."""

HARMLESS = ("os.listdir", "os.scandir")


class RefusedError(Exception):
    """What a file asks for is not done."""


def evaluated(expression: str, names: Mapping[str, Any], more: Mapping[str, Any]) -> Any:
    """The value of an expression of arithmetic, comparisons, texts, lists and mappings.

    Args:
        expression: What stands in the file.
        names: Values by name.
        more: Functions by name, beside `FUNCTIONS`.

    Raises:
        RefusedError: It holds anything else.
    """
    functions = {**FUNCTIONS, **more}
    variables: dict[str, Any] = {}  # variables of comprehensions

    def value(node: ast.AST) -> Any:
        match node:
            case ast.Expression(body=body):
                return value(body)
            case ast.Constant(value=found):
                return plain(found, node)
            case ast.Name(id=name):
                return plain(named(name), node)
            case ast.UnaryOp(op=op, operand=operand) if type(op) in OPERATORS:
                return OPERATORS[type(op)](value(operand))
            case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
                return OPERATORS[type(op)](value(left), value(right))
            case ast.BoolOp(op=op, values=values):
                found = None
                for one in values:
                    found = value(one)
                    if bool(found) == isinstance(op, ast.Or):
                        break
                return found
            case ast.Compare(left=left, ops=ops, comparators=others):
                found = value(left)
                for op, other in zip(ops, others, strict=True):
                    before, found = found, value(other)
                    if not OPERATORS[type(op)](before, found):
                        return False
                return True
            case ast.IfExp(test=test, body=body, orelse=orelse):
                return value(body if value(test) else orelse)
            case ast.List(elts=elts):
                return [value(one) for one in elts]
            case ast.Tuple(elts=elts):
                return tuple(value(one) for one in elts)
            case ast.Dict(keys=keys, values=values) if None not in keys:
                return {value(k): value(v) for k, v in zip(keys, values, strict=True) if k}
            case ast.Subscript(value=of, slice=ast.Slice(lower=low, upper=high, step=step)):
                return value(of)[
                    slice(*(None if x is None else value(x) for x in (low, high, step)))
                ]
            case ast.Subscript(value=of, slice=place):
                return plain(value(of)[value(place)], node)
            case ast.Attribute(value=of, attr=name):  # of a mapping, or of names with a scope
                found = named(of.id) if isinstance(of, ast.Name) else value(of)
                if not isinstance(found, dict):
                    raise refused(node)
                return plain(found[name], node)
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in functions:
                return functions[name](*map(value, args))
            case ast.Call(func=ast.Name(id="dict"), args=[], keywords=pairs) if all(
                pair.arg for pair in pairs
            ):
                return {pair.arg: value(pair.value) for pair in pairs}
            case ast.Call(
                func=ast.Attribute(value=ast.Name(id=scope), attr=name), args=args, keywords=[]
            ) if scope in SCOPES and name in functions:
                return functions[name](*map(value, args))
            case ast.Call(
                func=ast.Name(id="isinstance")
                | ast.Attribute(value=ast.Name(id="python"), attr="isinstance"),
                args=[of, ast.Name(id=kind)],
                keywords=[],
            ) if kind in TYPES:
                return isinstance(value(of), TYPES[kind])
            case ast.Call(func=ast.Attribute(value=of, attr=name), args=args, keywords=[]):
                owner = value(of)
                methods = [names for kind, names in METHODS.items() if isinstance(owner, kind)]
                if not methods or name not in methods[0]:
                    raise refused(node)
                kind = next(kind for kind in METHODS if isinstance(owner, kind))
                result = getattr(kind, name)(owner, *map(value, args))
                return list(result) if kind is dict and name != "get" else result
            case (
                ast.ListComp(elt=elt, generators=[ast.comprehension(target, of, tests)])
                | ast.GeneratorExp(elt=elt, generators=[ast.comprehension(target, of, tests)])
            ):
                several = isinstance(target, ast.Tuple)
                targets = target.elts if isinstance(target, ast.Tuple) else [target]
                results = []
                for item in value(of):
                    items = item if several else (item,)
                    for place, part in zip(targets, items, strict=True):
                        if not isinstance(place, ast.Name):
                            raise refused(node)
                        variables[place.id] = part
                    if all(value(test) for test in tests):
                        results.append(value(elt))
                return results
            case ast.Set(elts=elts):
                return {value(element) for element in elts}
            case _:
                raise refused(node)

    def named(name: str) -> Any:
        if name in variables:
            return variables[name]
        try:
            return names[name]
        except KeyError:
            raise RefusedError(f"name {name!r} is not defined") from None

    def plain(found: Any, node: ast.AST) -> Any:
        if not isinstance(found, PLAIN):
            raise refused(node)
        return found

    def refused(node: ast.AST) -> RefusedError:
        text = ast.get_source_segment(text_, node) or expression
        return RefusedError(
            f"{text!r} is not evaluated; expected arithmetic, comparisons, functions of numbers, "
            "and methods of texts and lists"
        )

    text_ = expression.strip()
    return value(ast.parse(text_, mode="eval"))


def package_folders(name: str, file: Path) -> tuple[list[Path], list[Path]]:
    """Folders that may be a ROS package.

    Args:
        name: The package's.
        file: The file that names it.

    Returns:
        Those above the file, or beside what is above it; and those that the environment leads to
        (ROS_PACKAGE_PATH, and ``share`` of AMENT_PREFIX_PATH).
    """

    def listed(variable: str) -> list[Path]:
        return [Path(one) for one in os.environ.get(variable, "").split(os.pathsep) if one]

    above, told = file.resolve().parents, listed("ROS_PACKAGE_PATH")
    near = [one / name for one in above] + [one for one in above if _is_package(one, name)]
    known = [one / name for one in told] + [one for one in told if one.name == name]
    known += [one / "share" / name for one in listed("AMENT_PREFIX_PATH")]
    return [one for one in near if one.is_dir()], [one for one in known if one.is_dir()]


def _is_package(folder: Path, name: str) -> bool:
    """Return whether a folder is a ROS package: it has the name, or its package.xml states it."""
    if folder.name == name:
        return True
    with contextlib.suppress(OSError, UnicodeDecodeError):
        text = (folder / "package.xml").read_text(encoding="utf-8")[:MANIFEST]
        return re.search(rf"<name>\s*{re.escape(name)}\s*</name>", text) is not None
    return False


MANIFEST = 100_000
"""Maximum number of characters of a package.xml in which the package's name is looked up."""


def expand_xacro(path: Path, arguments: Mapping[str, str], notes: list[str]) -> str:
    """Return the text of a file with its macros expanded.

    It reads files below its folder and those of packages it finds, and nothing else; expressions
    are `evaluated`, no code of the file runs. Parameters that a macro does not declare are ignored:
    files of makers pass such to newer versions of their macros.

    Args:
        path: The file.
        arguments: Values of the file's arguments by name.
        notes: List to which is added what was ignored.

    Raises:
        RefusedError: It asks for more.
    """
    import xml.dom.expatbuilder  # noqa: F401  # now: nothing can be imported later

    import xacro
    import yaml  # noqa: F401
    from xacro import substitution_args

    library: Any = xacro
    folders = [path.resolve().parent]
    for one in path.resolve().parents:
        if (one / "package.xml").is_file():
            folders.append(one)
            break

    def find(name: str) -> str:
        near, known = package_folders(name, path)
        # A folder of that name alone is none: it may be anybody's.
        near = [x for x in near if (x / "package.xml").is_file() or x in path.resolve().parents]
        if not near + known:
            raise RefusedError(
                f"package {name!r} is not found: name the folder that holds it in the environment, "
                "ROS_PACKAGE_PATH=FOLDER casadi-ik import ..."
            )
        folders.append((near + known)[0].resolve())
        return str(folders[-1])

    def argument(name: str, args: Mapping[str, Any] | None = None) -> Any:
        known = library.substitution_args_context["arg"] if args is None else args
        if name not in known and name == "name":
            return path.name.partition(".")[0]
        if name not in known:
            raise RefusedError(
                f"argument {name!r} has no default; write --xacro-args {name}:=VALUE, or "
                f"xacro: [{name}:=VALUE] in a description"
            )
        return known[name]

    call_macro = library.handle_macro_call

    def call(node: Any, macros: Any, symbols: Any) -> Any:
        if node.tagName.startswith("xacro:") and node.tagName != "xacro:call":
            with contextlib.suppress(KeyError):
                macro = library.resolve_macro(node.tagName[len("xacro:") :], macros, symbols)[2]
                for name in [name for name, _ in node.attributes.items()]:
                    if name not in macro.params:
                        node.removeAttribute(name)
                        notes.append(f"{node.tagName}: parameter {name!r} is not declared: ignored")
        return call_macro(node, macros, symbols)

    def extension(text: str, context: Mapping[str, Any]) -> str:
        values = {k: substitution_args.convert_value(v, "auto") for k, v in context["arg"].items()}
        known = {"pi": math.pi, "true": True, "false": False, **values}
        return str(evaluated(text, known, {"arg": argument, "find": find}))

    def variable(name: str) -> str:
        raise RefusedError(f"$(env {name}) is not read, expected no variables of the environment")

    more = {"load_yaml": library.load_yaml, "arg": argument}

    def expression(text: str, names: Mapping[str, Any], *_: Any) -> Any:
        return evaluated(text, names, more)

    ours = {
        (library, "safe_eval"): expression,
        (library, "handle_macro_call"): call,
        (substitution_args, "_eval"): extension,
        (substitution_args, "_eval_arg"): lambda name, args: argument(name, args),
        (substitution_args, "_eval_env"): variable,
        (substitution_args, "_eval_optenv"): lambda _, default="": default,
        (substitution_args, "_eval_find"): find,
    }
    for (module, name), function in ours.items():
        if not hasattr(module, name):
            raise RefusedError(
                f"the installed xacro has no {module.__name__}.{name}; pip install 'xacro>=2.1,<3'"
            )
        setattr(module, name, function)

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            file, _, flags = arguments
            reads = isinstance(file, str) and not flags & (os.O_WRONLY | os.O_RDWR)
            place = Path(file).resolve() if reads else None
            if place is None or not (below(place) or place in manifests):
                raise RefusedError(f"reads {str(file)!r}, expected a file below {folders[0]}")
        elif event.startswith(FORBIDDEN) and event not in HARMLESS:
            raise RefusedError(f"asks for {event} {arguments[:1]}, expected macros alone")

    manifests = {folder / "package.xml" for folder in path.resolve().parents}

    def below(place: Path) -> bool:
        return any(place.is_relative_to(folder) for folder in folders)

    sys.addaudithook(watch)
    document: Any = library.process_file(str(path), mappings=dict(arguments))
    return str(document.toxml())


def _compiled(library: Any, path: Path, notes: list[str]) -> Any:
    """Return MuJoCo's model of a file, without the meshes and pictures that cannot be read.

    Raises:
        ValueError: MuJoCo cannot read it.
    """
    try:
        return library.MjModel.from_xml_path(str(path))
    except ValueError as error:
        text = str(error)
        if text.startswith(UNKNOWN):
            raise
    left_out: set[str] = set()
    while True:
        spec = _without(library, path, left_out)
        try:
            return spec.compile()
        except ValueError as error:
            text = str(error)
        broken = {_mesh_name(mesh) for mesh in spec.meshes if _names_mesh(text, mesh)}
        if not broken:
            raise ValueError(text)
        left_out |= broken
        reason = " ".join(text.split()).replace(str(path.parent) + os.sep, "")
        notes += [f"mesh {name!r} is left out: {reason}" for name in sorted(broken)]


def _without(library: Any, path: Path, left_out: Collection[str]) -> Any:
    """Return what a file describes, without pictures, masses and some meshes."""
    spec = library.MjSpec.from_file(str(path))
    spec.compiler.boundmass, spec.compiler.boundinertia = BOUND_MASS, BOUND_INERTIA
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for item in [*spec.textures, *spec.skins]:
        spec.delete(item)
    for geom in spec.geoms:
        if geom.meshname in left_out:
            geom.meshname, geom.type = "", library.mjtGeom.mjGEOM_SPHERE
            geom.size = [TINY, 0, 0]
            geom.contype = geom.conaffinity = 0
    for mesh in spec.meshes:
        if _mesh_name(mesh) in left_out:
            spec.delete(mesh)
        else:  # masses are not needed, and those of thin meshes are refused
            mesh.inertia = library.mjtMeshInertia.mjMESH_INERTIA_SHELL
    return spec


def _mesh_name(mesh: Any) -> str:
    return str(mesh.name or Path(mesh.file).stem)


def _names_mesh(message: str, mesh: Any) -> bool:
    """Return whether an error message of MuJoCo is about a mesh."""
    file = Path(mesh.file).name
    return bool(file and re.search(rf"[/\\']{re.escape(file)}'", message)) or bool(
        mesh.name and f"mesh '{mesh.name}'" in message
    )


BOUND_MASS, BOUND_INERTIA = 1e-3, 1e-6
"""Least mass [kg] and inertia [kg m^2] of bodies whose shapes are left out."""

TINY = 1e-5
"""Radius of a ball in the place of a mesh that is left out [m]; it is no shape of the link."""


def compile_mjcf(path: Path, notes: list[str]) -> bytes:
    """Return MuJoCo's model of a file, as MuJoCo saves one.

    Args:
        path: The file.
        notes: List to which is added what was left out.

    Raises:
        ValueError: MuJoCo cannot read it, or it has numbers that no robot has.
    """
    import mujoco
    import numpy as np

    library: Any = mujoco
    model = _compiled(library, path, notes)
    for name in NUMBERS:
        if not (np.abs(getattr(model, name)) <= LARGEST).all():
            raise RefusedError(f"{name}: expected finite numbers up to {LARGEST:g}")
    if np.isnan(model.jnt_range).any():
        raise RefusedError("jnt_range: holds NaN, expected numbers")
    if (np.abs(np.linalg.norm(model.jnt_axis, axis=1) - 1) > 1e-6).any():
        raise RefusedError("jnt_axis: one is no direction")
    found = np.empty(library.mj_sizeModel(model), np.uint8)
    library.mj_saveModel(model, None, found)
    return found.tobytes()


def _limited(seconds: int, memory: int) -> None:
    try:
        import resource
    except ImportError:  # Windows: time alone is limited, from outside
        return
    limits = {"CPU": seconds, "AS": memory, "CORE": 0, "FSIZE": 0}
    for what, most in limits.items():
        try:
            resource.setrlimit(getattr(resource, f"RLIMIT_{what}"), (most, most))
        except (OSError, ValueError, AttributeError):  # not where it is not known
            continue


def reason(error: BaseException) -> str:
    """Return why a file is refused: the message of `RefusedError` if a library has wrapped one."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, RefusedError):
        cause = getattr(cause, "exc", None) or cause.__cause__ or cause.__context__
    if cause is not None:
        return str(cause)
    text = str(error) or type(error).__name__
    module = sys.modules.get("xacro.substitution_args")
    context = getattr(sys.modules.get("xacro"), "substitution_args_context", {})
    if module is not None and context.get("arg"):
        text += f"; its arguments are {', '.join(context['arg'])} (--xacro-args NAME:=VALUE)"
    return text


def main(words: list[str]) -> int:
    """Do what the words say; see the module."""
    what, path, (seconds, memory, most) = words[0], Path(words[1]), map(int, words[2:5])
    pairs = (word.partition(":=") for word in words[5:])
    arguments = {name: value for name, _, value in pairs}
    _limited(seconds, memory)
    # What libraries say goes nowhere: behind the answer nothing may stand.
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    code, notes = 0, list[str]()
    try:
        found = (
            expand_xacro(path, arguments, notes).encode()
            if what == "xacro"
            else compile_mjcf(path, notes)
        )
        if len(found) > most:
            text = f"it becomes {len(found) >> 20} MiB, expected at most {most >> 20}"
            code, found = REFUSED, text.encode()
        if not code:
            found = json.dumps(notes[:NOTES]).encode() + b"\n" + found
    except MemoryError:
        return 1
    except BaseException as error:
        text = reason(error)
        if text.startswith(UNKNOWN):
            return 1
        code, found = REFUSED, text[:4000].encode(errors="replace")
    answer.write(found)
    answer.flush()
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
