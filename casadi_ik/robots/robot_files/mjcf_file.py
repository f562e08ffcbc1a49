"""MJCF as a tree of joints: MuJoCo reads it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.errors import DescriptionError
from casadi_ik.files.limits import LIMITS
from casadi_ik.robots.couplings import Coupling, Linear, Polynomial
from casadi_ik.robots.poses import motion
from casadi_ik.robots.robot_files.confined import MODEL, confined
from casadi_ik.robots.robot_files.tree import (
    RobotTree,
    TreeJoint,
    check_size,
    fixed,
    mjcf_pose,
    mjcf_shapes,
)

WORLD = "world"
"""MuJoCo's name of what does not move."""


SAVED = "model.mjb"
"""What MuJoCo is told that a model is called, which it had saved."""


def mujoco_model(path: Path) -> tuple[Any, Any]:
    """The module and its model of a file.

    Raises:
        DescriptionError: MuJoCo cannot read it.
        MissingExtraError: MuJoCo is not installed.
    """
    saved = confined(MODEL, path)
    import mujoco

    library: Any = mujoco  # its types are made when it is imported
    return library, library.MjModel.from_binary_path(SAVED, {SAVED: saved})


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
    mujoco, model = mujoco_model(path)
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
    return RobotTree(path, root, tuple(joints), motors, shapes, model=(mujoco, model))


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
        return [fixed(f"{names[body]}_fixed", parent, names[body], placement)]
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
            pose = placement @ anchor @ motion("revolute", axis, -zero)
            after: Array = np.asarray(np.linalg.inv(anchor), dtype=np.float64)
        else:
            pose, after = placement.copy(), np.eye(4)
            if kind == "prismatic":
                pose[:3, 3] -= placement[:3, :3] @ axis * zero
        still = np.allclose(after, np.eye(4), rtol=0, atol=0)
        carried = child if still else f"{child}:anchor"
        coupling = couplings.get(name)
        found.append(TreeJoint(name, parent, carried, kind, pose, axis, limits, math.inf, coupling))
        if not still:
            found.append(fixed(f"{name}_anchor", carried, child, after))
        parent, placement = child, np.eye(4)
    return found


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
