"""Script that expands xacro and compiles MJCF files from untrusted sources, with limits.

`urdf_mjcf.run_sandbox` starts a process for every file, so the module imports only the standard
library at first. Arguments: task ("xacro" or "mujoco"), file, limits (CPU time [s], bytes of memory
and of output) and the xacro arguments, NAME:=VALUE. The script writes a line of notes (JSON list)
and the result, and exits with 0; or it writes the reason and exits with `REFUSED`.
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
"""Exit code if the file is refused."""

VALUE_TYPES = (bool, int, float, str, list, tuple, dict, set, type(None))
"""Types of values in expressions."""

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
    ast.In: lambda item, container: item in container,
    ast.NotIn: lambda item, container: item not in container,
    ast.Is: operator.is_,
    ast.IsNot: operator.is_not,
}
"""Operators of expressions, by node type."""

FUNCTIONS: dict[str, Callable[..., Any]] = {
    **{name: f for name, f in vars(math).items() if name[0] != "_" and callable(f)},
    **{f.__name__: f for f in (abs, all, any, bool, float, int, len, max, min, round, str, sum)},
    **{f.__name__: f for f in (dict, list, set, sorted, tuple)},
    "enumerate": lambda values: list(enumerate(values)),
    "range": lambda *bounds: list(range(*bounds)),
    "zip": lambda *columns: list(zip(*columns, strict=False)),
}
"""Functions of expressions, by name."""

TYPES_BY_NAME = {kind.__name__: kind for kind in VALUE_TYPES[:-1]}
"""Types that expressions may pass to `isinstance`."""

CALLABLE_METHODS: dict[type, tuple[str, ...]] = {
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
"""Methods that expressions may call, by the type of their object."""

NAMESPACES = ("math", "python", "xacro")
"""Prefixes of function names, as in ``math.sin``."""

FORBIDDEN_EVENTS = (
    *("exec", "import", "os.", "shutil.", "subprocess.", "socket.", "ctypes.", "pty.", "fcntl."),
    *("mmap.", "pickle.", "marshal.", "code.", "function.", "sqlite3.", "urllib.", "webbrowser."),
)
"""Prefixes of the audit events that are refused during the expansion of macros."""

ALLOWED_EVENTS = ("os.listdir", "os.scandir")
"""Audit events that are allowed in spite of `FORBIDDEN_EVENTS`."""

CHECKED_FIELDS = (
    *("body_pos", "body_quat", "jnt_pos", "jnt_axis", "qpos0", "eq_data", "wrap_prm", "mesh_vert"),
    *("geom_pos", "geom_quat", "geom_size"),
)
"""Fields of MuJoCo's model that become numbers of the robot."""

MAX_FIELD_VALUE = 1e6
"""Largest magnitude in `CHECKED_FIELDS`."""

MAX_NOTES = 100
"""Maximum number of notes."""

OUT_OF_MEMORY_MESSAGE = "Caught an unknown exception"
"""Start of MuJoCo's message when it runs out of memory."""


class RefusedError(Exception):
    """The file is refused."""


def evaluate(expression: str, names: Mapping[str, Any], extra_functions: Mapping[str, Any]) -> Any:
    """Evaluate an expression of arithmetic, comparisons, strings, lists and dictionaries.

    Args:
        expression: Python expression.
        names: Values by name.
        extra_functions: Functions by name, in addition to `FUNCTIONS`.

    Raises:
        RefusedError: The expression contains other syntax.
    """
    functions = {**FUNCTIONS, **extra_functions}
    variables: dict[str, Any] = {}  # variables of comprehensions
    source = expression.strip()

    def evaluate_node(node: ast.AST) -> Any:
        """Return the value of a node of the syntax tree."""
        match node:
            case ast.Expression(body=body):
                return evaluate_node(body)
            case ast.Constant(value=constant):
                return checked(constant, node)
            case ast.Name(id=name):
                return checked(look_up(name), node)
            case ast.UnaryOp(op=op, operand=operand) if type(op) in OPERATORS:
                return OPERATORS[type(op)](evaluate_node(operand))
            case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
                return OPERATORS[type(op)](evaluate_node(left), evaluate_node(right))
            case ast.BoolOp(op=op, values=values):
                result = None
                for operand in values:
                    result = evaluate_node(operand)
                    if bool(result) == isinstance(op, ast.Or):
                        break
                return result
            case ast.Compare(left=left, ops=ops, comparators=comparators):
                previous = evaluate_node(left)
                for op, comparator in zip(ops, comparators, strict=True):
                    current = evaluate_node(comparator)
                    if not OPERATORS[type(op)](previous, current):
                        return False
                    previous = current
                return True
            case ast.IfExp(test=test, body=body, orelse=orelse):
                return evaluate_node(body if evaluate_node(test) else orelse)
            case ast.List(elts=elts):
                return [evaluate_node(element) for element in elts]
            case ast.Tuple(elts=elts):
                return tuple(evaluate_node(element) for element in elts)
            case ast.Dict(keys=keys, values=values) if None not in keys:
                return {
                    evaluate_node(k): evaluate_node(v)
                    for k, v in zip(keys, values, strict=True)
                    if k
                }
            case ast.Subscript(value=sequence, slice=ast.Slice(lower=low, upper=high, step=step)):
                bounds = (None if x is None else evaluate_node(x) for x in (low, high, step))
                return evaluate_node(sequence)[slice(*bounds)]
            case ast.Subscript(value=container, slice=index):
                return checked(evaluate_node(container)[evaluate_node(index)], node)
            case ast.Attribute(value=owner, attr=name):  # a key of a dictionary or namespace
                mapping = look_up(owner.id) if isinstance(owner, ast.Name) else evaluate_node(owner)
                if not isinstance(mapping, dict):
                    raise refused(node)
                return checked(mapping[name], node)
            case ast.Call(func=ast.Name(id=name), args=args, keywords=[]) if name in functions:
                return functions[name](*map(evaluate_node, args))
            case ast.Call(func=ast.Name(id="dict"), args=[], keywords=pairs) if all(
                pair.arg for pair in pairs
            ):
                return {pair.arg: evaluate_node(pair.value) for pair in pairs}
            case ast.Call(
                func=ast.Attribute(value=ast.Name(id=prefix), attr=name), args=args, keywords=[]
            ) if prefix in NAMESPACES and name in functions:
                return functions[name](*map(evaluate_node, args))
            case ast.Call(
                func=ast.Name(id="isinstance")
                | ast.Attribute(value=ast.Name(id="python"), attr="isinstance"),
                args=[argument, ast.Name(id=kind)],
                keywords=[],
            ) if kind in TYPES_BY_NAME:
                return isinstance(evaluate_node(argument), TYPES_BY_NAME[kind])
            case ast.Call(func=ast.Attribute(value=owner, attr=name), args=args, keywords=[]):
                instance = evaluate_node(owner)
                kinds = [kind for kind in CALLABLE_METHODS if isinstance(instance, kind)]
                if not kinds or name not in CALLABLE_METHODS[kinds[0]]:
                    raise refused(node)
                result = getattr(kinds[0], name)(instance, *map(evaluate_node, args))
                return list(result) if kinds[0] is dict and name != "get" else result
            case (
                ast.ListComp(elt=elt, generators=[ast.comprehension(target, iterable, tests)])
                | ast.GeneratorExp(elt=elt, generators=[ast.comprehension(target, iterable, tests)])
            ):
                targets = target.elts if isinstance(target, ast.Tuple) else [target]
                results = []
                for item in evaluate_node(iterable):
                    items = item if isinstance(target, ast.Tuple) else (item,)
                    for variable, part in zip(targets, items, strict=True):
                        if not isinstance(variable, ast.Name):
                            raise refused(node)
                        variables[variable.id] = part
                    if all(evaluate_node(test) for test in tests):
                        results.append(evaluate_node(elt))
                return results
            case ast.Set(elts=elts):
                return {evaluate_node(element) for element in elts}
            case _:
                raise refused(node)

    def look_up(name: str) -> Any:
        """Return the value of a variable or name."""
        if name in variables:
            return variables[name]
        try:
            return names[name]
        except KeyError:
            raise RefusedError(f"name {name!r} is not defined") from None

    def checked(result: Any, node: ast.AST) -> Any:
        """Return a value of one of `VALUE_TYPES`; refuse others."""
        if not isinstance(result, VALUE_TYPES):
            raise refused(node)
        return result

    def refused(node: ast.AST) -> RefusedError:
        """Return the error for a node that is not evaluated."""
        text = ast.get_source_segment(source, node) or expression
        return RefusedError(
            f"{text!r} is not evaluated; expected arithmetic, comparisons, functions of numbers, "
            "and methods of strings and lists"
        )

    return evaluate_node(ast.parse(source, mode="eval"))


def package_folders(name: str, file: Path) -> tuple[list[Path], list[Path]]:
    """Return folders that may be a ROS package.

    Args:
        name: Name of the package.
        file: File that refers to the package.

    Returns:
        Folders above the file or next to these, and folders that the environment states
        (ROS_PACKAGE_PATH, and ``share`` of AMENT_PREFIX_PATH).
    """

    def folders_of(variable: str) -> list[Path]:
        return [Path(part) for part in os.environ.get(variable, "").split(os.pathsep) if part]

    above, ros_folders = file.resolve().parents, folders_of("ROS_PACKAGE_PATH")
    nearby = [folder / name for folder in above]
    nearby += [folder for folder in above if _is_package(folder, name)]
    in_environment = [folder / name for folder in ros_folders]
    in_environment += [folder for folder in ros_folders if folder.name == name]
    in_environment += [folder / "share" / name for folder in folders_of("AMENT_PREFIX_PATH")]
    return (
        [folder for folder in nearby if folder.is_dir()],
        [folder for folder in in_environment if folder.is_dir()],
    )


def _is_package(folder: Path, name: str) -> bool:
    """Return whether a folder is a ROS package: it has the name, or its package.xml states it."""
    if folder.name == name:
        return True
    with contextlib.suppress(OSError, UnicodeDecodeError):
        text = (folder / "package.xml").read_text(encoding="utf-8")[:MAX_MANIFEST_LENGTH]
        return re.search(rf"<name>\s*{re.escape(name)}\s*</name>", text) is not None
    return False


MAX_MANIFEST_LENGTH = 100_000
"""Number of characters of a package.xml that are searched for the name of the package."""


def expand_xacro(path: Path, arguments: Mapping[str, str], notes: list[str]) -> str:
    """Return the text of a file with its macros expanded.

    The file can read files in its folder and in the packages that it refers to. `evaluate` computes
    its expressions; no code of the file is executed. Undeclared parameters of macros are ignored,
    because files of manufacturers pass parameters of newer versions of their macros.

    Args:
        path: xacro file.
        arguments: Values of the file's arguments by name.
        notes: List to which a note is added for each ignored parameter.

    Raises:
        RefusedError: The file reads other files, or contains expressions that are not evaluated.
    """
    import xml.dom.expatbuilder  # noqa: F401  # imports are refused later

    import xacro
    import yaml  # noqa: F401
    from xacro import substitution_args

    library: Any = xacro
    folders = [path.resolve().parent]
    for folder in path.resolve().parents:
        if (folder / "package.xml").is_file():
            folders.append(folder)
            break

    def find(name: str) -> str:
        """Return the folder of a package, which the file may read from now on."""
        nearby, in_environment = package_folders(name, path)
        # A neighbouring folder that only has the name may be unrelated to the file.
        above = path.resolve().parents
        nearby = [x for x in nearby if (x / "package.xml").is_file() or x in above]
        candidates = nearby + in_environment
        if not candidates:
            raise RefusedError(
                f"package {name!r} is not found; state the folder that contains it in the "
                "environment: ROS_PACKAGE_PATH=FOLDER casadi-ik import ..."
            )
        folders.append(candidates[0].resolve())
        return str(folders[-1])

    def argument(name: str, args: Mapping[str, Any] | None = None) -> Any:
        """Return the value of an argument of the file."""
        values = library.substitution_args_context["arg"] if args is None else args
        if name not in values and name == "name":
            return path.name.partition(".")[0]
        if name not in values:
            raise RefusedError(
                f"argument {name!r} has no default; write --xacro-args {name}:=VALUE, or "
                f"xacro: [{name}:=VALUE] in a description"
            )
        return values[name]

    call_macro = library.handle_macro_call

    def call(node: Any, macros: Any, symbols: Any) -> Any:
        """Call a macro without its undeclared parameters."""
        if node.tagName.startswith("xacro:") and node.tagName != "xacro:call":
            with contextlib.suppress(KeyError):
                macro = library.resolve_macro(node.tagName[len("xacro:") :], macros, symbols)[2]
                for name in [name for name, _ in node.attributes.items()]:
                    if name not in macro.params:
                        node.removeAttribute(name)
                        notes.append(f"{node.tagName}: undeclared parameter {name!r} is ignored")
        return call_macro(node, macros, symbols)

    def extension(text: str, context: Mapping[str, Any]) -> str:
        values = {k: substitution_args.convert_value(v, "auto") for k, v in context["arg"].items()}
        names = {"pi": math.pi, "true": True, "false": False, **values}
        return str(evaluate(text, names, {"arg": argument, "find": find}))

    def variable(name: str) -> str:
        raise RefusedError(f"$(env {name}): environment variables are not read; expected none")

    xacro_functions = {"load_yaml": library.load_yaml, "arg": argument}

    def expression(text: str, names: Mapping[str, Any], *_: Any) -> Any:
        return evaluate(text, names, xacro_functions)

    replacements = {
        (library, "safe_eval"): expression,
        (library, "handle_macro_call"): call,
        (substitution_args, "_eval"): extension,
        (substitution_args, "_eval_arg"): lambda name, args: argument(name, args),
        (substitution_args, "_eval_env"): variable,
        (substitution_args, "_eval_optenv"): lambda _, default="": default,
        (substitution_args, "_eval_find"): find,
    }
    for (module, name), function in replacements.items():
        if not hasattr(module, name):
            raise RefusedError(
                f"the installed xacro has no {module.__name__}.{name}; pip install 'xacro>=2.1,<3'"
            )
        setattr(module, name, function)

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            file, _, flags = arguments
            reads = isinstance(file, str) and not flags & (os.O_WRONLY | os.O_RDWR)
            target = Path(file).resolve() if reads else None
            if target is None or not (in_folders(target) or target in manifests):
                raise RefusedError(f"reads {str(file)!r}; expected a file below {folders[0]}")
        elif event.startswith(FORBIDDEN_EVENTS) and event not in ALLOWED_EVENTS:
            raise RefusedError(f"requests {event} {arguments[:1]}; expected only macros")

    manifests = {folder / "package.xml" for folder in path.resolve().parents}

    def in_folders(target: Path) -> bool:
        return any(target.is_relative_to(folder) for folder in folders)

    sys.addaudithook(watch)
    document: Any = library.process_file(str(path), mappings=dict(arguments))
    return str(document.toxml())


def _compiled(library: Any, path: Path, notes: list[str]) -> Any:
    """Return MuJoCo's model of a file; meshes and textures that cannot be read are omitted.

    Raises:
        ValueError: MuJoCo cannot read the file.
    """
    try:
        return library.MjModel.from_xml_path(str(path))
    except ValueError as error:
        text = str(error)
        if text.startswith(OUT_OF_MEMORY_MESSAGE):
            raise
    omitted: set[str] = set()
    while True:
        spec = _spec(library, path, omitted)
        try:
            return spec.compile()
        except ValueError as error:
            text = str(error)
        broken = {_mesh_name(mesh) for mesh in spec.meshes if _names_mesh(text, mesh)}
        if not broken:
            raise ValueError(text)
        omitted |= broken
        reason = " ".join(text.split()).replace(str(path.parent) + os.sep, "")
        notes += [f"mesh {name!r} is omitted: {reason}" for name in sorted(broken)]


def _spec(library: Any, path: Path, omitted_meshes: Collection[str]) -> Any:
    """Return the specification of a file without textures, skins, masses and some meshes."""
    spec = library.MjSpec.from_file(str(path))
    spec.compiler.boundmass, spec.compiler.boundinertia = BOUND_MASS, BOUND_INERTIA
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    for item in [*spec.textures, *spec.skins]:
        spec.delete(item)
    for geom in spec.geoms:
        if geom.meshname in omitted_meshes:
            geom.meshname, geom.type = "", library.mjtGeom.mjGEOM_SPHERE
            geom.size = [OMITTED_MESH_RADIUS, 0, 0]
            geom.contype = geom.conaffinity = 0
    for mesh in spec.meshes:
        if _mesh_name(mesh) in omitted_meshes:
            spec.delete(mesh)
        else:  # MuJoCo refuses the volume of thin meshes, and masses are not used
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
"""Minimum mass [kg] and inertia [kg m^2] of bodies, whose shapes may be omitted."""

OMITTED_MESH_RADIUS = 1e-5
"""Radius of the ball that replaces an omitted mesh [m]; it does not become a shape of the link."""


def compile_mjcf(path: Path, notes: list[str]) -> bytes:
    """Return MuJoCo's model of a file in its binary format.

    Args:
        path: MJCF file.
        notes: List to which a note is added for each omitted mesh.

    Raises:
        ValueError: MuJoCo cannot read the file.
        RefusedError: A number of the model is not finite or too large.
    """
    import mujoco
    import numpy as np

    library: Any = mujoco
    model = _compiled(library, path, notes)
    for name in CHECKED_FIELDS:
        if not (np.abs(getattr(model, name)) <= MAX_FIELD_VALUE).all():
            raise RefusedError(
                f"{name}: a number is not finite or too large; expected at most {MAX_FIELD_VALUE:g}"
            )
    if np.isnan(model.jnt_range).any():
        raise RefusedError("jnt_range: a limit is NaN; expected numbers")
    if (np.abs(np.linalg.norm(model.jnt_axis, axis=1) - 1) > 1e-6).any():
        raise RefusedError("jnt_axis: an axis is not a direction; expected a vector of length > 0")
    model_data = np.empty(library.mj_sizeModel(model), np.uint8)
    library.mj_saveModel(model, None, model_data)
    return model_data.tobytes()


def _set_limits(seconds: int, memory: int) -> None:
    """Limit CPU time [s] and memory [bytes] of this process, and forbid it to write files."""
    try:
        import resource
    except ImportError:  # On Windows only the parent process limits the time.
        return
    limits = {"CPU": seconds, "AS": memory, "CORE": 0, "FSIZE": 0}
    for name, limit in limits.items():
        try:
            resource.setrlimit(getattr(resource, f"RLIMIT_{name}"), (limit, limit))
        except (OSError, ValueError, AttributeError):  # the platform does not have this limit
            continue


def refusal_reason(error: BaseException) -> str:
    """Return why a file is refused: the message of a wrapped `RefusedError` if there is one."""
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
    """Run the script with its command-line arguments; return the exit code."""
    task, path, (seconds, memory, max_size) = words[0], Path(words[1]), map(int, words[2:5])
    pairs = (word.partition(":=") for word in words[5:])
    arguments = {name: value for name, _, value in pairs}
    _set_limits(seconds, memory)
    # Output of libraries is discarded, so that it cannot mix with the result.
    result_stream = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    code, notes = 0, list[str]()
    try:
        output = (
            expand_xacro(path, arguments, notes).encode()
            if task == "xacro"
            else compile_mjcf(path, notes)
        )
        if len(output) > max_size:
            text = f"expands to {len(output) >> 20} MiB; expected at most {max_size >> 20}"
            code, output = REFUSED, text.encode()
        if not code:
            output = json.dumps(notes[:MAX_NOTES]).encode() + b"\n" + output
    except MemoryError:
        return 1
    except BaseException as error:
        text = refusal_reason(error)
        if text.startswith(OUT_OF_MEMORY_MESSAGE):
            return 1
        code, output = REFUSED, text[:4000].encode(errors="replace")
    result_stream.write(output)
    result_stream.flush()
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
