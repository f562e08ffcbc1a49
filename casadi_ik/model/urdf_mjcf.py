"""A robot's file, URDF or MJCF, as a tree of joints.

Somebody's macros and MJCF are read by a process of its own, which may die of them.
"""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.errors import DescriptionError, MissingExtraError, os_errors
from casadi_ik.files.arrays import Array
from casadi_ik.files.limits import LIMITS, RAISE_HINT, scaled_limit
from casadi_ik.model import sandbox as foreign
from casadi_ik.model.couplings import Coupling, Linear, Polynomial
from casadi_ik.model.linkage import joint_motion, parents_first
from casadi_ik.model.xml_tree import (
    Element,
    RobotTree,
    TreeJoint,
    check_size,
    check_vector,
    finite_number,
    fixed_tree_joint,
    mjcf_pose,
    mjcf_shapes,
    origin_pose,
    parse_xml,
    read_robot_file,
    required_attribute,
    urdf_shapes,
)

XACRO_READER = "xacro"
MJCF_READER = "mujoco"


def run_sandbox(
    what: str, path: Path, arguments: Sequence[str] = ()
) -> tuple[bytes, tuple[str, ...]]:
    """What a file becomes.

    Args:
        what: `XACRO_READER` (text with expanded macros) or `MJCF_READER` (MuJoCo's saved model).
        path: The file.
        arguments: Values of its arguments, NAME:=VALUE, if it has macros.

    Raises:
        DescriptionError: It cannot be read, asks for what is not done, or for too much.
        MissingExtraError: xacro or MuJoCo is not installed.
    """
    if find_spec(what) is None:
        noun = "has xacro macros" if what == XACRO_READER else "is MJCF"
        raise MissingExtraError(f"{path}: {noun}; to read it: pip install 'casadi-ik[{what}]'")
    seconds, doing = (
        scaled_limit(LIMITS.reader_seconds),
        "expand" if what == XACRO_READER else "read",
    )
    limits = (seconds, scaled_limit(LIMITS.reader_memory), scaled_limit(LIMITS.reader_output))
    # Not the script's folder, whose modules are called as some of others are.
    script, place = Path(foreign.__file__).resolve(), path.resolve()
    command = [sys.executable, "-P", str(script), what, str(place), *map(str, limits), *arguments]
    known = os.pathsep.join(str(Path(one).resolve()) for one in sys.path)
    try:
        with tempfile.TemporaryDirectory() as folder:  # MuJoCo keeps a log where it runs
            done = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                cwd=folder,
                env=os.environ | {"PYTHONPATH": known},
                timeout=LIMITS.reader_patience * seconds,
                check=False,
            )
    except subprocess.TimeoutExpired:
        code, said = 1, b""
    except (OSError, ValueError) as error:
        raise DescriptionError(f"{path}: no process to read it: {error}") from error
    else:
        code, said = done.returncode, done.stdout
    if code == 0:
        notes, _, content = said.partition(b"\n")
        return content, tuple(f"{path.name}: {note}" for note in json.loads(notes))
    reason = f"takes more than {seconds} s of computing or {limits[1] >> 20} MiB {RAISE_HINT}"
    if code == foreign.REFUSED:
        reason = " ".join(said.decode(errors="replace").split())
    raise DescriptionError(f"{path}: {what} cannot {doing} it: {reason}")


WORLD = "world"
"""MuJoCo's name of what does not move."""


SAVED = "model.mjb"
"""What MuJoCo is told that a model is called, which it had saved."""


def mujoco_model(path: Path) -> tuple[Any, Any, tuple[str, ...]]:
    """Return the module, its model of a file, and notes on what was left out.

    Raises:
        DescriptionError: MuJoCo cannot read it.
        MissingExtraError: MuJoCo is not installed.
    """
    saved, notes = run_sandbox(MJCF_READER, path)
    import mujoco

    library: Any = mujoco  # its types are made when it is imported
    return library, library.MjModel.from_binary_path(SAVED, {SAVED: saved}), notes


def read_mjcf(path: Path) -> RobotTree:
    """Read an MJCF file.

    A body of several joints becomes as many links, named BODY:JOINT but for the last. Joints that
    an equality couples follow by its polynomial. Those on a fixed tendon that an actuator pulls
    become one motor of the tendon's name, which is the tendon's length; each moves by the part of
    it that its range is of all their ranges.

    Raises:
        DescriptionError: See `mujoco_model`; or something that has no form here.
        MissingExtraError: MuJoCo is not installed.
    """
    mujoco, model, notes = mujoco_model(path)
    check_size(model.nbody, model.njnt, path)
    couplings = _equalities(mujoco, model, path)
    motors = _tendons(mujoco, model, couplings)
    names = [model.body(i).name or f"body_{i}" for i in range(model.nbody)]
    names[0] = WORLD
    joints: list[TreeJoint] = []
    for body in range(1, model.nbody):
        joints += _of_body(mujoco, model, body, names, couplings)
    roots = [joint for joint in joints if joint.parent == WORLD]
    root = WORLD
    if len(roots) == 1 and roots[0].type in ("fixed", "free"):
        root = roots[0].child
        joints.remove(roots[0])
    shapes = mjcf_shapes(mujoco, model, names)
    return RobotTree(path, root, tuple(joints), motors, shapes, model=(mujoco, model), notes=notes)


def joint_name(model: Any, joint: int) -> str:
    """A joint's name; one without is called after its body."""
    name: str = model.joint(joint).name
    return name or f"{model.body(int(model.jnt_bodyid[joint])).name}_joint_{joint}"


def _of_body(
    mujoco: Any, model: Any, body: int, names: list[str], couplings: dict[str, Coupling]
) -> list[TreeJoint]:
    """The joints of a body in order, or the fixed one that holds it."""
    placement = mjcf_pose(mujoco, model.body_pos[body], model.body_quat[body])
    parent = names[model.body_parentid[body]]
    first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    if count == 0:
        return [fixed_tree_joint(f"{names[body]}_fixed", parent, names[body], placement)]
    found: list[TreeJoint] = []
    for joint in range(first, first + count):
        last = joint == first + count - 1
        name = joint_name(model, joint)
        kind = {
            int(mujoco.mjtJoint.mjJNT_HINGE): "revolute",
            int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic",
            int(mujoco.mjtJoint.mjJNT_FREE): "free",
        }.get(int(model.jnt_type[joint]), "ball")
        anchor, axis = np.eye(4), np.array(model.jnt_axis[joint])
        anchor[:3, 3] = model.jnt_pos[joint]
        child = names[body] if last else f"{names[body]}:{name}"
        limits = None
        if model.jnt_limited[joint] and np.abs(model.jnt_range[joint]).max() <= LIMITS.joint_limit:
            limits = (float(model.jnt_range[joint, 0]), float(model.jnt_range[joint, 1]))
        elif kind == "revolute":
            kind = "continuous"
        zero = float(model.qpos0[model.jnt_qposadr[joint]])
        if kind in ("revolute", "continuous"):
            # The axis goes through the anchor: the link's frame is there while the joint turns.
            pose = placement @ anchor @ joint_motion("revolute", axis, -zero)
            after: Array = np.asarray(np.linalg.inv(anchor), dtype=np.float64)
        else:
            pose, after = placement.copy(), np.eye(4)
            if kind == "prismatic":
                pose[:3, 3] -= placement[:3, :3] @ axis * zero
        still = np.allclose(after, np.eye(4), rtol=0, atol=0)
        carried = child if still else f"{child}:anchor"
        coupling = couplings.get(name)
        effort = _effort(mujoco, model, joint)
        found.append(
            TreeJoint(name, parent, carried, kind, pose, axis, limits, math.inf, coupling, effort)
        )
        if not still:
            found.append(fixed_tree_joint(f"{name}_anchor", carried, child, after))
        parent, placement = child, np.eye(4)
    return found


def _effort(mujoco: Any, model: Any, joint: int) -> float:
    """The largest torque or force of the actuators on a joint, inf where the file limits none."""
    most = math.inf
    if model.jnt_actfrclimited[joint]:
        most = float(np.abs(model.jnt_actfrcrange[joint]).max())
    driven = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (
        model.actuator_trnid[:, 0] == joint
    )
    if driven.any() and model.actuator_forcelimited[driven].all():
        ranges = np.abs(model.actuator_forcerange[driven]).max(axis=1)
        most = min(most, float((ranges * np.abs(model.actuator_gear[driven, 0])).sum()))
    return most or math.inf


def _equalities(mujoco: Any, model: Any, path: Path) -> dict[str, Coupling]:
    """Couplings of joints by the joint that follows."""
    found: dict[str, Coupling] = {}
    for i in range(model.neq):
        if model.eq_type[i] != mujoco.mjtEq.mjEQ_JOINT or not model.eq_active0[i]:
            continue
        follower, leader = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        name = joint_name(model, follower)
        terms = [float(value) for value in model.eq_data[i, :5]]
        if leader < 0:
            raise DescriptionError(
                f"{path}: joint {name!r}: an equality holds it at {terms[0]:.6g}; write "
                f"locked: {{{name}: {terms[0]:.6g}}}"
            )
        # The polynomial is one of displacements from the initial positions.
        start = float(model.qpos0[model.jnt_qposadr[follower]])
        other = float(model.qpos0[model.jnt_qposadr[leader]])
        if any(terms[2:]) or other:
            shifted = np.polynomial.Polynomial(terms)(np.polynomial.Polynomial([-other, 1.0]))
            values = [*shifted.coef.tolist(), *[0.0] * (5 - len(shifted.coef))]
            values[0] += start
            if not any(values[2:]):
                found[name] = Linear(joint_name(model, leader), values[1], values[0])
            else:
                found[name] = Polynomial(joint_name(model, leader), tuple(values))
        else:
            found[name] = Linear(joint_name(model, leader), terms[1], terms[0] + start)
    return found


def _tendons(
    mujoco: Any, model: Any, couplings: dict[str, Coupling]
) -> dict[str, tuple[float, float]]:
    """Motors that pull fixed tendons, by name; their joints' couplings are added."""
    pulled = {
        int(model.actuator_trnid[i, 0])
        for i in range(model.nu)
        if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_TENDON
    }
    motors: dict[str, tuple[float, float]] = {}
    named = {joint_name(model, joint) for joint in range(model.njnt)}
    for tendon in sorted(pulled):
        first, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
        wraps = range(first, first + count)
        if any(model.wrap_type[i] != mujoco.mjtWrap.mjWRAP_JOINT for i in wraps):
            continue  # one that runs through space
        pulls = [(int(model.wrap_objid[i]), float(model.wrap_prm[i])) for i in wraps]
        joints = [joint for joint, ratio in pulls if ratio]
        ratios = [ratio for _, ratio in pulls if ratio]
        ranges = [model.jnt_range[joint] for joint in joints]
        limited = all(
            model.jnt_limited[joint] and -LIMITS.joint_limit <= low < high <= LIMITS.joint_limit
            for joint, (low, high) in zip(joints, ranges, strict=True)
        )
        taken = any(joint_name(model, joint) in couplings for joint in joints)
        if not limited or taken or len(joints) < 2:
            continue
        name = model.tendon(tendon).name or f"tendon_{tendon}"
        while name in named:
            name = f"{name}_tendon"
        # From where all joints are slack to where all are pulled.
        slack = [float(r[0] if c > 0 else r[1]) for c, r in zip(ratios, ranges, strict=True)]
        taut = [float(r[1] if c > 0 else r[0]) for c, r in zip(ratios, ranges, strict=True)]
        low = sum(c * value for c, value in zip(ratios, slack, strict=True))
        high = sum(c * value for c, value in zip(ratios, taut, strict=True))
        motors[name] = (low, high)
        for joint, start, end in zip(joints, slack, taut, strict=True):
            ratio = (end - start) / (high - low)
            couplings[joint_name(model, joint)] = Linear(name, ratio, start - ratio * low)
    return motors


URDF_JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")


def read_urdf(element: Element, path: Path) -> RobotTree:
    """Read a URDF.

    Args:
        element: Its element ``robot``.
        path: The file it is from.

    Raises:
        DescriptionError: It describes no tree, or nonsense; the message names file and joint.
    """
    links = [
        required_attribute(link, "name", f"{path}: a link") for link in element.findall("link")
    ]
    elements = element.findall("joint")
    check_size(len(links), sum(one.get("type") != "fixed" for one in elements), path)
    names = [required_attribute(joint, "name", f"{path}: a joint") for joint in elements]
    _once(links, "link", path)
    _once(names, "joint", path)
    joints = dict(zip(names, elements, strict=True))
    for name, joint in joints.items():
        _check(joint, links, f"{path}: joint {name!r}")
    root = _root(links, joints, path)
    if not joints:
        raise DescriptionError(f"{path}: has no joints ({len(links)} links)")
    found = [_joint(one, name, f"{path}: joint {name!r}") for name, one in joints.items()]
    ordered = parents_first(found, root)
    return RobotTree(path, root, ordered, shapes=urdf_shapes(element), element=element)


def _once(names: list[str], noun: str, path: Path) -> None:
    for name, count in Counter(names).items():
        if count > 1:
            raise DescriptionError(f"{path}: {noun} {name!r} appears twice")


def _check(joint: Element, links: list[str], where: str) -> None:
    """Everything that pinocchio would refuse without saying where."""
    kind = joint.get("type")
    if kind not in URDF_JOINT_TYPES:
        raise DescriptionError(
            f"{where}: type: found {kind!r}, expected one of {', '.join(URDF_JOINT_TYPES)}"
        )
    for end in ("parent", "child"):
        link = required_attribute(joint.find(end), "link", f"{where}: {end}")
        if link not in links:
            raise DescriptionError(f"{where}: {end}: there is no link {link!r}")
    for name in ("xyz", "rpy"):
        check_vector(joint.find("origin"), name, f"{where}: origin")
    axis = joint.find("axis")
    check_vector(axis, "xyz", f"{where}: axis")
    if kind not in ("fixed", "floating") and not np.linalg.norm(_direction(axis)) > 1e-9:
        raise DescriptionError(f"{where}: axis: is zero, expected a direction")
    limit_element = joint.find("limit")
    ends = _ends(limit_element, where)
    for rate in ("velocity", "effort"):
        finite_number(limit_element, rate, f"{where}: limit", math.inf)
    low, high = (end or 0.0 for end in ends)
    if low > high:
        raise DescriptionError(f"{where}: limit: lower {low:.6g} is above upper {high:.6g}")


def _root(links: list[str], joints: dict[str, Element], path: Path) -> str:
    parents: dict[str, str] = {}
    for name, joint in joints.items():
        child = joint.find("child").get("link", "")  # type: ignore[union-attr]
        if child in parents:
            raise DescriptionError(
                f"{path}: joint {name!r}: link {child!r} hangs on two joints, expected a tree; "
                "take one out of the file"
            )
        parents[child] = joint.find("parent").get("link", "")  # type: ignore[union-attr]
    roots = [link for link in links if link not in parents]
    if not roots:
        cycle = f", there is a cycle through link {links[0]!r}" if links else ", it has no link"
        raise DescriptionError(f"{path}: there is no base link{cycle}")
    if len(roots) > 1:
        raise DescriptionError(
            f"{path}: found several base links ({', '.join(roots)}), expected one: join them by a "
            "fixed joint"
        )
    for link in links:
        seen = set()
        while link in parents:
            if link in seen:
                raise DescriptionError(f"{path}: there is a cycle through link {link!r}")
            seen.add(link)
            link = parents[link]
    return roots[0]


def _joint(element: Element, name: str, where: str) -> TreeJoint:
    kind, axis, limit_element = (
        element.get("type", ""),
        np.array([0.0, 0.0, 1.0]),
        element.find("limit"),
    )
    if kind in ("revolute", "continuous", "prismatic"):
        axis = np.array(_direction(element.find("axis")))
        axis /= np.linalg.norm(axis)
    velocity, effort = (
        abs(finite_number(limit_element, rate, f"{where}: limit", math.inf) or math.inf)
        for rate in ("velocity", "effort")
    )
    placement = origin_pose(element)
    assert placement is not None  # its vectors are checked
    return TreeJoint(
        name,
        required_attribute(element.find("parent"), "link", where),
        required_attribute(element.find("child"), "link", where),
        kind,
        placement,
        axis,
        _limits(limit_element, where) if kind in ("revolute", "prismatic") else None,
        velocity,
        _mimic(element, where),
        effort,
    )


def _direction(axis: Element | None) -> list[float]:
    """An axis as stated; x where nothing is, as URDF has it."""
    text = "" if axis is None else axis.get("xyz", "")
    return [float(word) for word in text.split()] or [1.0, 0.0, 0.0]


def _limits(limit_element: Element | None, where: str) -> tuple[float, float] | None:
    """The range that is stated; an end that is left out is zero in URDF if the other is there."""
    ends = _ends(limit_element, where)
    if ends == [None, None] or max(abs(end or 0.0) for end in ends) > LIMITS.joint_limit:
        return None
    return ends[0] or 0.0, ends[1] or 0.0


def _ends(limit_element: Element | None, where: str) -> list[float | None]:
    return [
        finite_number(limit_element, name, f"{where}: limit", math.inf)
        for name in ("lower", "upper")
    ]


def _mimic(element: Element, where: str) -> Coupling | None:
    mimic = element.find("mimic")
    if mimic is None or element.get("type") == "fixed":
        return None
    where = f"{where}: mimic"
    ratio = finite_number(mimic, "multiplier", where)
    offset = finite_number(mimic, "offset", where)
    leader = required_attribute(mimic, "joint", where)
    return Linear(leader, 1.0 if ratio is None else ratio, offset or 0.0)


MACRO_TAGS = ("{http://www.ros.org/wiki/xacro}", "{http://ros.org/wiki/xacro}")
"""How the tags of macros begin."""


def read_tree(path: Path, xacro: bool | Sequence[str] = False) -> RobotTree:
    """Read a robot's file.

    Args:
        path: URDF, xacro or MJCF.
        xacro: Values of its arguments, NAME:=VALUE; True: its macros are expanded although it is
            not called ``.xacro``.

    Raises:
        DescriptionError: It is missing or malformed; the message names file and joint.
        MissingExtraError: What reads this format is not installed.
    """
    with os_errors(f"{path}: cannot be read", DescriptionError):
        stamp = path.stat().st_mtime_ns
    arguments = () if isinstance(xacro, bool) else tuple(xacro)
    for word in arguments:
        if not re.fullmatch(r"\w+:=.*", word):
            raise DescriptionError(f"{path}: xacro: argument {word!r} is not NAME:=VALUE")
    return _read(path, stamp, bool(xacro) or path.suffix == ".xacro", arguments)


@lru_cache(maxsize=8)
def _read(path: Path, _: int, xacro: bool, arguments: tuple[str, ...]) -> RobotTree:
    text = read_robot_file(path)
    element, notes = parse_xml(text, path), ()
    if xacro and element.tag == "robot":
        expanded, notes = run_sandbox(XACRO_READER, path, arguments)
        element = parse_xml(expanded.decode(), path)
    if element.tag not in ("robot", "mujoco"):
        raise DescriptionError(
            f"{path}: found <{element.tag}>, expected a URDF (<robot>) or an MJCF (<mujoco>)"
        )
    if element.tag == "mujoco":
        return read_mjcf(path)
    for one in element.iter():
        if one.tag.startswith(MACRO_TAGS):
            raise DescriptionError(
                f"{path}: found macros (<xacro:{one.tag.rpartition('}')[2]}>), expected plain "
                "URDF; to have them expanded, call the file .xacro, or import it with --xacro"
            )
    return replace(read_urdf(element, path), notes=notes)
