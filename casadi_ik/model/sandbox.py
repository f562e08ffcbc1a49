"""What reads somebody's macros and MJCF, run as a script: in a process of its own, with limits.

Standard library only, since it starts once for every file: `confined.py` runs it. The words behind
it are what to do, the file, and the limits: seconds of computing, bytes of memory and of output. It
prints what came out and ends with 0, or prints a reason and ends with `REFUSED`.
"""

from __future__ import annotations

import ast
import math
import operator
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

REFUSED = 3
"""How the process ends if the file is refused."""

PLAIN = (bool, int, float, str, list, tuple, dict, type(None))
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
    **{f.__name__: f for f in (abs, bool, float, int, len, max, min, round, str, sum)},
}

OF_TEXT = ("startswith", "endswith", "lower", "upper", "strip", "replace", "split", "join")
"""What may be called of a text."""

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
            case ast.Call(
                func=ast.Attribute(value=ast.Name(id=scope), attr=name), args=args, keywords=[]
            ) if scope in SCOPES and name in functions:
                return functions[name](*map(value, args))
            case ast.Call(func=ast.Attribute(value=of, attr=name), args=args, keywords=[]) if (
                name in OF_TEXT
            ):
                text = value(of)
                if type(text) is not str:
                    raise refused(node)
                return getattr(text, name)(*map(value, args))
            case _:
                raise refused(node)

    def named(name: str) -> Any:
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
            f"{text!r} is not evaluated, expected arithmetic, comparisons and functions of numbers"
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
    near = [one / name for one in above] + [one for one in above if one.name == name]
    known = [one / name for one in told] + [one for one in told if one.name == name]
    known += [one / "share" / name for one in listed("AMENT_PREFIX_PATH")]
    return [one for one in near if one.is_dir()], [one for one in known if one.is_dir()]


def expand_xacro(path: Path) -> str:
    """A file with its macros expanded.

    It reads files below its folder and those of packages it finds, and nothing else; expressions
    are `evaluated`, no code of the file runs.

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
        near = [x for x in near if (x / "package.xml").is_file() or x == path.resolve().parents[1]]
        if not near + known:
            raise RefusedError(
                f"package {name!r} is not found: name the folder that holds it in the environment, "
                "ROS_PACKAGE_PATH=FOLDER casadi-ik import ..."
            )
        folders.append((near + known)[0].resolve())
        return str(folders[-1])

    def argument(name: str) -> Any:
        return library.substitution_args_context["arg"][name]

    def extension(text: str, context: Mapping[str, Any]) -> str:
        values = {k: substitution_args.convert_value(v, "auto") for k, v in context["arg"].items()}
        known = {"pi": math.pi, "true": True, "false": False, **values}
        return str(evaluated(text, known, {"arg": values.__getitem__, "find": find}))

    def variable(name: str) -> str:
        raise RefusedError(f"$(env {name}) is not read, expected no variables of the environment")

    more = {"load_yaml": library.load_yaml, "arg": argument}

    def expression(text: str, names: Mapping[str, Any], *_: Any) -> Any:
        return evaluated(text, names, more)

    ours = {
        (library, "safe_eval"): expression,
        (substitution_args, "_eval"): extension,
        (substitution_args, "_eval_env"): variable,
        (substitution_args, "_eval_optenv"): lambda _, default="": default,
        (substitution_args, "_eval_find"): find,
    }
    for (module, name), function in ours.items():
        if not hasattr(module, name):
            raise RefusedError("this version of xacro is not known; pip install xacro==2.1.1")
        setattr(module, name, function)

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            file, _, flags = arguments
            reads = isinstance(file, str) and not flags & (os.O_WRONLY | os.O_RDWR)
            if not (reads and below(Path(file).resolve())):
                raise RefusedError(f"reads {str(file)!r}, expected a file below {folders[0]}")
        elif event.startswith(FORBIDDEN) and event not in HARMLESS:
            raise RefusedError(f"asks for {event} {arguments[:1]}, expected macros alone")

    def below(place: Path) -> bool:
        return any(place.is_relative_to(folder) for folder in folders)

    sys.addaudithook(watch)
    document: Any = library.process_file(str(path))
    return str(document.toxml())


def compile_mjcf(path: Path) -> bytes:
    """MuJoCo's model of a file, as it saves one.

    Raises:
        ValueError: MuJoCo cannot read it, or it has numbers that no robot has.
    """
    import mujoco
    import numpy as np

    library: Any = mujoco
    model = library.MjModel.from_xml_path(str(path))
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


def main(words: list[str]) -> int:
    """Do what the words say; see the module."""
    what, path, (seconds, memory, most) = words[0], Path(words[1]), map(int, words[2:])
    _limited(seconds, memory)
    # What libraries say goes nowhere: behind the answer nothing may stand.
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    code = 0
    try:
        found = expand_xacro(path).encode() if what == "xacro" else compile_mjcf(path)
        if len(found) > most:
            text = f"it becomes {len(found) >> 20} MiB, expected at most {most >> 20}"
            code, found = REFUSED, text.encode()
    except MemoryError:
        return 1
    except BaseException as error:
        text = str(error) or type(error).__name__
        if text.startswith(UNKNOWN):
            return 1
        code, found = REFUSED, text[:4000].encode(errors="replace")
    answer.write(found)
    answer.flush()
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
