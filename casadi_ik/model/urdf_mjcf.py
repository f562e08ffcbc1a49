"""Readers for URDF and MJCF files, which give trees of joints.

Macros and MJCF are read by a separate process (`sandbox`), which may crash on malformed files.
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
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.errors import DescriptionError, MissingExtraError, install_command, os_errors
from casadi_ik.files.arrays import Array
from casadi_ik.files.input_checks import (
    MAX_DEGREES,
    warn_of_angles,
    warn_of_joint_limit,
    warn_of_joint_offset,
)
from casadi_ik.files.limits import LIMITS, RAISE_HINT, scaled_limit
from casadi_ik.model import sandbox
from casadi_ik.model.couplings import Coupling, Linear, Polynomial
from casadi_ik.model.joints import joint_motion, parents_first
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
    parse_numbers,
    parse_xml,
    read_robot_file,
    required_attribute,
    urdf_shapes,
)

XACRO_READER = "xacro"
"""Name of the package that expands macros."""

MJCF_READER = "mujoco"
"""Name of the package that reads MJCF."""


def run_sandbox(
    reader: str, path: Path, arguments: Sequence[str] = ()
) -> tuple[bytes, tuple[str, ...]]:
    """Return the output of the sandbox for a file, and its notes.

    Args:
        reader: `XACRO_READER` (text with expanded macros) or `MJCF_READER` (MuJoCo's saved model).
        path: xacro or MJCF file.
        arguments: Values of the file's arguments, NAME:=VALUE.

    Raises:
        DescriptionError: The file cannot be read, uses forbidden functions, or exceeds a limit.
        MissingExtraError: xacro or MuJoCo is not installed.
    """
    if find_spec(reader) is None:
        noun = "has xacro macros" if reader == XACRO_READER else "is MJCF"
        raise MissingExtraError(f"{path}: {noun}; to read it: {install_command(reader)}")
    verb = "expand" if reader == XACRO_READER else "read"
    seconds = scaled_limit(LIMITS.reader_seconds)
    limits = (seconds, scaled_limit(LIMITS.reader_memory), scaled_limit(LIMITS.reader_output))
    # -P excludes the script's folder, whose modules have the names of other packages' modules.
    script, file = str(Path(sandbox.__file__).resolve()), str(path.resolve())
    command = [sys.executable, "-P", script, reader, file, *map(str, limits), *arguments]
    python_path = os.pathsep.join(str(Path(folder).resolve()) for folder in sys.path)
    try:
        with tempfile.TemporaryDirectory() as folder:  # MuJoCo writes a log to its working folder
            process = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                cwd=folder,
                env=os.environ | {"PYTHONPATH": python_path},
                timeout=LIMITS.reader_patience * seconds,
                check=False,
            )
    except subprocess.TimeoutExpired:
        code, output = 1, b""
    except (OSError, ValueError) as error:
        raise DescriptionError(f"{path}: the reader process cannot start: {error}") from error
    else:
        code, output = process.returncode, process.stdout
    if code == 0:
        notes, _, content = output.partition(b"\n")
        return content, tuple(f"{path.name}: {note}" for note in json.loads(notes))
    reason = f"takes more than {seconds} s of computing or {limits[1] >> 20} MiB {RAISE_HINT}"
    if code == sandbox.REFUSED:
        reason = " ".join(output.decode(errors="replace").split())
    raise DescriptionError(f"{path}: {reader} cannot {verb} it: {reason}")


WORLD = "world"
"""MuJoCo's name of the fixed world."""

SAVED_MODEL = "model.mjb"
"""Virtual file name under which a saved model is passed to MuJoCo."""


def mujoco_model(path: Path) -> tuple[Any, Any, tuple[str, ...]]:
    """Return the module mujoco, its model of a file, and notes on omitted parts.

    Raises:
        DescriptionError: MuJoCo cannot read the file.
        MissingExtraError: MuJoCo is not installed.
    """
    saved, notes = run_sandbox(MJCF_READER, path)
    import mujoco

    library: Any = mujoco  # a compiled module without static types
    model = library.MjModel.from_binary_path(SAVED_MODEL, {SAVED_MODEL: saved})
    return library, model, notes


def read_mjcf(path: Path) -> RobotTree:
    """Read an MJCF file.

    A body with several joints becomes one link per joint, named BODY:JOINT except for the last. A
    joint equality becomes a polynomial coupling. The joints of a fixed tendon with an actuator
    follow a motor with the tendon's name, whose position is the length of the tendon; the positions
    of the joints in their ranges are proportional to it.

    Raises:
        DescriptionError: See `mujoco_model`; or a part of the model is not supported.
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
        joints += _body_joints(mujoco, model, body, names, couplings)
    roots = [joint for joint in joints if joint.parent == WORLD]
    root = WORLD
    if len(roots) == 1 and roots[0].type in ("fixed", "free"):
        root = roots[0].child
        joints.remove(roots[0])
    shapes = mjcf_shapes(mujoco, model, names)
    return RobotTree(path, root, tuple(joints), motors, shapes, model=(mujoco, model), notes=notes)


def joint_name(model: Any, joint: int) -> str:
    """Return the name of a joint; an unnamed one is named after its body."""
    name: str = model.joint(joint).name
    return name or f"{model.body(int(model.jnt_bodyid[joint])).name}_joint_{joint}"


def _body_joints(
    mujoco: Any, model: Any, body: int, names: list[str], couplings: dict[str, Coupling]
) -> list[TreeJoint]:
    """Return the joints between a body and its parent in order, or the fixed joint."""
    placement = mjcf_pose(mujoco, model.body_pos[body], model.body_quat[body])
    parent = names[model.body_parentid[body]]
    first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
    if count == 0:
        return [fixed_tree_joint(f"{names[body]}_fixed", parent, names[body], placement)]
    joints: list[TreeJoint] = []
    for joint in range(first, first + count):
        is_last = joint == first + count - 1
        name = joint_name(model, joint)
        kind = {
            int(mujoco.mjtJoint.mjJNT_HINGE): "revolute",
            int(mujoco.mjtJoint.mjJNT_SLIDE): "prismatic",
            int(mujoco.mjtJoint.mjJNT_FREE): "free",
        }.get(int(model.jnt_type[joint]), "ball")
        anchor, axis = np.eye(4), np.array(model.jnt_axis[joint])
        anchor[:3, 3] = model.jnt_pos[joint]
        child = names[body] if is_last else f"{names[body]}:{name}"
        limits = None
        if model.jnt_limited[joint] and np.abs(model.jnt_range[joint]).max() <= LIMITS.joint_limit:
            limits = (float(model.jnt_range[joint, 0]), float(model.jnt_range[joint, 1]))
        elif kind == "revolute":
            kind = "continuous"
        zero = float(model.qpos0[model.jnt_qposadr[joint]])
        if kind in ("revolute", "continuous"):
            # The joint rotates about the anchor; an intermediate link has its frame there.
            pose = placement @ anchor @ joint_motion("revolute", axis, -zero)
            offset: Array = np.asarray(np.linalg.inv(anchor), dtype=np.float64)
        else:
            pose, offset = placement.copy(), np.eye(4)
            if kind == "prismatic":
                pose[:3, 3] -= placement[:3, :3] @ axis * zero
        is_at_anchor = np.allclose(offset, np.eye(4), rtol=0, atol=0)
        joint_link = child if is_at_anchor else f"{child}:anchor"
        coupling = couplings.get(name)
        effort = _effort(mujoco, model, joint)
        joints.append(
            TreeJoint(
                name, parent, joint_link, kind, pose, axis, limits, math.inf, coupling, effort
            )
        )
        if not is_at_anchor:
            joints.append(fixed_tree_joint(f"{name}_anchor", joint_link, child, offset))
        parent, placement = child, np.eye(4)
    return joints


def _effort(mujoco: Any, model: Any, joint: int) -> float:
    """Return the largest torque or force of the actuators on a joint, inf if unlimited."""
    effort = math.inf
    if model.jnt_actfrclimited[joint]:
        effort = float(np.abs(model.jnt_actfrcrange[joint]).max())
    driven = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (
        model.actuator_trnid[:, 0] == joint
    )
    if driven.any() and model.actuator_forcelimited[driven].all():
        ranges = np.abs(model.actuator_forcerange[driven]).max(axis=1)
        effort = min(effort, float((ranges * np.abs(model.actuator_gear[driven, 0])).sum()))
    return effort or math.inf


def _equalities(mujoco: Any, model: Any, path: Path) -> dict[str, Coupling]:
    """Return the couplings of joint equalities by the joint that follows."""
    couplings: dict[str, Coupling] = {}
    for i in range(model.neq):
        if model.eq_type[i] != mujoco.mjtEq.mjEQ_JOINT or not model.eq_active0[i]:
            continue
        follower, leader = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        name = joint_name(model, follower)
        terms = [float(value) for value in model.eq_data[i, :5]]
        if leader < 0:
            raise DescriptionError(
                f"{path}: joint {name!r}: an equality fixes it at {terms[0]:.6g}; write "
                f"locked: {{{name}: {terms[0]:.6g}}}"
            )
        # MuJoCo's polynomial is in displacements from the initial positions.
        start = float(model.qpos0[model.jnt_qposadr[follower]])
        leader_start = float(model.qpos0[model.jnt_qposadr[leader]])
        if any(terms[2:]) or leader_start:
            shifted = np.polynomial.Polynomial(terms)(
                np.polynomial.Polynomial([-leader_start, 1.0])
            )
            values = [*shifted.coef.tolist(), *[0.0] * (5 - len(shifted.coef))]
            values[0] += start
            if not any(values[2:]):
                couplings[name] = Linear(joint_name(model, leader), values[1], values[0])
            else:
                couplings[name] = Polynomial(joint_name(model, leader), tuple(values))
        else:
            couplings[name] = Linear(joint_name(model, leader), terms[1], terms[0] + start)
    return couplings


def _tendons(
    mujoco: Any, model: Any, couplings: dict[str, Coupling]
) -> dict[str, tuple[float, float]]:
    """Return the motors of fixed tendons by name, and add the couplings of their joints."""
    pulled = {
        int(model.actuator_trnid[i, 0])
        for i in range(model.nu)
        if model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_TENDON
    }
    motors: dict[str, tuple[float, float]] = {}
    joint_names = {joint_name(model, joint) for joint in range(model.njnt)}
    for tendon in sorted(pulled):
        first, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
        wraps = range(first, first + count)
        if any(model.wrap_type[i] != mujoco.mjtWrap.mjWRAP_JOINT for i in wraps):
            continue  # a spatial tendon
        pulls = [(int(model.wrap_objid[i]), float(model.wrap_prm[i])) for i in wraps]
        joints = [joint for joint, ratio in pulls if ratio]
        ratios = [ratio for _, ratio in pulls if ratio]
        ranges = [model.jnt_range[joint] for joint in joints]
        limited = all(
            model.jnt_limited[joint] and -LIMITS.joint_limit <= low < high <= LIMITS.joint_limit
            for joint, (low, high) in zip(joints, ranges, strict=True)
        )
        has_coupling = any(joint_name(model, joint) in couplings for joint in joints)
        if not limited or has_coupling or len(joints) < 2:
            continue
        name = model.tendon(tendon).name or f"tendon_{tendon}"
        while name in joint_names:
            name = f"{name}_tendon"
        # The motor moves all joints together from their slack to their taut ends.
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
        element: The ``robot`` element.
        path: URDF file, for error messages.

    Raises:
        DescriptionError: The file is not a tree, or is invalid; the message names file and joint.
    """
    links = [
        required_attribute(link, "name", f"{path}: a link") for link in element.findall("link")
    ]
    elements = element.findall("joint")
    check_size(len(links), sum(joint.get("type") != "fixed" for joint in elements), path)
    names = [required_attribute(joint, "name", f"{path}: a joint") for joint in elements]
    _check_unique(links, "link", path)
    _check_unique(names, "joint", path)
    joints = dict(zip(names, elements, strict=True))
    for name, joint in joints.items():
        _check_joint(joint, links, f"{path}: joint {name!r}")
    _warn_of_units(joints, path)
    root = _root(links, joints, path)
    if not joints:
        raise DescriptionError(
            f"{path}: file has no joints ({len(links)} links); expected at least one"
        )
    tree_joints = [_joint(item, name, f"{path}: joint {name!r}") for name, item in joints.items()]
    ordered = parents_first(tree_joints, root)
    return RobotTree(path, root, ordered, shapes=urdf_shapes(element), element=element)


def _check_unique(names: list[str], noun: str, path: Path) -> None:
    for name, count in Counter(names).items():
        if count > 1:
            raise DescriptionError(f"{path}: {noun} {name!r} appears twice; expected unique names")


def _check_joint(joint: Element, links: list[str], location: str) -> None:
    """Check the elements of a joint for which pinocchio would raise an unspecific error."""
    kind = joint.get("type")
    if kind not in URDF_JOINT_TYPES:
        raise DescriptionError(
            f"{location}: type: found {kind!r}, expected one of {', '.join(URDF_JOINT_TYPES)}"
        )
    for end in ("parent", "child"):
        link = required_attribute(joint.find(end), "link", f"{location}: {end}")
        if link not in links:
            raise DescriptionError(
                f"{location}: {end}: link {link!r} does not exist; expected a link of the file"
            )
    for name in ("xyz", "rpy"):
        check_vector(joint.find("origin"), name, f"{location}: origin")
    axis = joint.find("axis")
    check_vector(axis, "xyz", f"{location}: axis")
    if kind not in ("fixed", "floating") and not np.linalg.norm(_direction(axis)) > 1e-9:
        raise DescriptionError(f"{location}: axis: is zero; expected a direction")
    limit_element = joint.find("limit")
    limits = _stated_limits(limit_element, location)
    for rate in ("velocity", "effort"):
        finite_number(limit_element, rate, f"{location}: limit", math.inf)
    low, high = (limit or 0.0 for limit in limits)
    if low > high:
        raise DescriptionError(f"{location}: limit: lower {low:.6g} is above upper {high:.6g}")


def _warn_of_units(joints: Mapping[str, Element], path: Path) -> None:
    """Warn of the joints with the largest numbers if they are probably in mm or degrees."""

    def origin(name: str, key: str) -> list[float]:
        element = joints[name].find("origin")
        return parse_numbers("0 0 0" if element is None else element.get(key, "0 0 0"))

    def limit(name: str) -> float:
        is_revolute = joints[name].get("type") == "revolute"
        limits = _stated_limits(joints[name].find("limit"), name) if is_revolute else []
        return max((abs(value or 0.0) for value in limits), default=0.0)

    offsets = {name: math.hypot(*origin(name, "xyz")) for name in joints}
    angles = {name: max(map(abs, origin(name, "rpy"))) for name in joints}
    limits = {name: limit(name) for name in joints if limit(name) <= MAX_DEGREES}
    for values, warn in (
        (offsets, warn_of_joint_offset),
        (angles, lambda angle, location: warn_of_angles([angle], f"{location}: origin: rpy")),
        (limits, warn_of_joint_limit),
    ):
        if values:
            name = max(values, key=values.__getitem__)
            warn(values[name], f"{path}: joint {name!r}")


def _root(links: list[str], joints: dict[str, Element], path: Path) -> str:
    """Return the base link of a URDF after checking that its joints form a tree."""
    parents: dict[str, str] = {}
    for name, joint in joints.items():
        child = joint.find("child").get("link", "")  # type: ignore[union-attr]
        if child in parents:
            raise DescriptionError(
                f"{path}: joint {name!r}: link {child!r} has two parents; expected a tree"
            )
        parents[child] = joint.find("parent").get("link", "")  # type: ignore[union-attr]
    roots = [link for link in links if link not in parents]
    if not roots:
        cycle = f", because of a cycle through link {links[0]!r}" if links else ""
        raise DescriptionError(f"{path}: the base link is missing{cycle}; expected a tree")
    if len(roots) > 1:
        raise DescriptionError(
            f"{path}: several base links ({', '.join(roots)}); expected one: join them by a fixed "
            "joint"
        )
    for link in links:
        visited = set()
        while link in parents:
            if link in visited:
                raise DescriptionError(f"{path}: link {link!r} is part of a cycle; expected a tree")
            visited.add(link)
            link = parents[link]
    return roots[0]


def _joint(element: Element, name: str, location: str) -> TreeJoint:
    """Return the joint of an element of a URDF."""
    kind, limit_element = element.get("type", ""), element.find("limit")
    axis = np.array([0.0, 0.0, 1.0])
    if kind in ("revolute", "continuous", "prismatic"):
        axis = np.array(_direction(element.find("axis")))
        axis /= np.linalg.norm(axis)
    velocity, effort = (
        abs(finite_number(limit_element, rate, f"{location}: limit", math.inf) or math.inf)
        for rate in ("velocity", "effort")
    )
    placement = origin_pose(element)
    assert placement is not None  # _check_joint has checked its vectors
    return TreeJoint(
        name=name,
        parent=required_attribute(element.find("parent"), "link", location),
        child=required_attribute(element.find("child"), "link", location),
        type=kind,
        placement=placement,
        axis=axis,
        limits=_limits(limit_element, location) if kind in ("revolute", "prismatic") else None,
        velocity=velocity,
        coupling=_mimic(element, location),
        effort=effort,
    )


def _direction(axis: Element | None) -> list[float]:
    """Return the axis as stated; the default of URDF is x."""
    text = "" if axis is None else axis.get("xyz", "")
    return [float(word) for word in text.split()] or [1.0, 0.0, 0.0]


def _limits(limit_element: Element | None, location: str) -> tuple[float, float] | None:
    """Return the stated range; in URDF one missing end is zero."""
    limits = _stated_limits(limit_element, location)
    if limits == [None, None] or max(abs(x or 0.0) for x in limits) > LIMITS.joint_limit:
        return None
    return limits[0] or 0.0, limits[1] or 0.0


def _stated_limits(limit_element: Element | None, location: str) -> list[float | None]:
    return [
        finite_number(limit_element, name, f"{location}: limit", math.inf)
        for name in ("lower", "upper")
    ]


def _mimic(element: Element, location: str) -> Coupling | None:
    """Return the coupling of a joint that mimics another one; None for other joints."""
    mimic = element.find("mimic")
    if mimic is None or element.get("type") == "fixed":
        return None
    location = f"{location}: mimic"
    ratio = finite_number(mimic, "multiplier", location)
    offset = finite_number(mimic, "offset", location)
    leader = required_attribute(mimic, "joint", location)
    return Linear(leader, 1.0 if ratio is None else ratio, offset or 0.0)


MACRO_TAGS = ("{http://www.ros.org/wiki/xacro}", "{http://ros.org/wiki/xacro}")
"""XML namespaces of macros."""


def read_tree(path: Path, xacro: bool | Sequence[str] = False) -> RobotTree:
    """Read a robot file.

    Args:
        path: URDF, xacro or MJCF.
        xacro: Values of the file's arguments, NAME:=VALUE; True: expand macros although the name
            of the file does not end with ``.xacro``.

    Raises:
        DescriptionError: The file is missing or malformed; the message names file and joint.
        MissingExtraError: The package that reads this format is not installed.
    """
    with os_errors(f"{path}: cannot be read", DescriptionError):
        stamp = path.stat().st_mtime_ns
    arguments = () if isinstance(xacro, bool) else tuple(xacro)
    for word in arguments:
        if not re.fullmatch(r"\w+:=.*", word):
            raise DescriptionError(
                f"{path}: xacro: argument {word!r} is invalid; expected NAME:=VALUE"
            )
    return _read(path, stamp, bool(xacro) or path.suffix == ".xacro", arguments)


@lru_cache(maxsize=8)
def _read(path: Path, _: int, xacro: bool, arguments: tuple[str, ...]) -> RobotTree:
    """Return the tree of a file, which is cached.

    The second argument is the time of the last change, so that a changed file is read again.
    """
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
    for child in element.iter():
        if child.tag.startswith(MACRO_TAGS):
            raise DescriptionError(
                f"{path}: found macros (<xacro:{child.tag.rpartition('}')[2]}>), expected plain "
                "URDF; to expand them, rename the file to .xacro or import it with --xacro"
            )
    return replace(read_urdf(element, path), notes=notes)
