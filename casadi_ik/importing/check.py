"""Whether an imported robot moves as its files say: their own libraries are asked again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from casadi_ik.arm_hand import ArmHand
from casadi_ik.arrays import Array
from casadi_ik.errors import MissingExtraError
from casadi_ik.importing.robot_shapes import hand_links, name_in_robot
from casadi_ik.robots.read_tree import joint_name
from casadi_ik.robots.tree import RobotTree


def largest_difference(
    robot: ArmHand,
    tree: RobotTree,
    q: Array,
    locked: Mapping[str, float] | None = None,
    beside: RobotTree | None = None,
    carried: RobotTree | None = None,
) -> float:
    """How far the links of a robot are from where its file's library has them.

    Args:
        robot: The robot, imported from the file, alone or as a part.
        tree: The file.
        q: (k, n) positions of the actuators [rad or m].
        locked: Joints that the description holds, and where.
        beside: The file of the arm that this file's hand is on, whose names go before.
        carried: The file of the hand that is on this file's arm: a name that it has too may be of
            a link beyond the arm's tip, which the robot does not have.

    Returns:
        The largest entry of the difference of any two poses, relative to the first link of the
        file that the robot has.

    Raises:
        MissingExtraError: Its library is not installed.
    """
    known = _MuJoCo(*tree.model) if tree.model is not None else _Pinocchio(tree.element)
    taken = set() if beside is None else _names(beside)
    links = {link: name_in_robot(link, robot.description.links, taken) for link in tree.links}
    if beside is not None or carried is not None:
        hand = hand_links(robot.description)
        links = {link: ours for link, ours in links.items() if (ours in hand) == (carried is None)}
    joints = {
        one.name: name_in_robot(one.name, robot.description.joint_names, taken)
        for one in tree.joints
    }
    worst = 0.0
    for configuration in q:
        angles = robot.joints(configuration)
        given = {name: angles[ours] for name, ours in joints.items() if ours in angles}
        values = {name: _value(tree, name, given, locked or {}) for name in tree.by_name}
        theirs, found = known.poses(values), robot.links(configuration)
        pairs = [
            (theirs[link], found[ours])
            for link, ours in links.items()
            if ours in found and link in theirs
        ]
        first = pairs[0]
        for one, other in pairs:
            difference = np.linalg.inv(first[0]) @ one - np.linalg.inv(first[1]) @ other
            worst = max(worst, float(np.abs(difference).max()))
    return worst


def _names(tree: RobotTree) -> set[str]:
    return {*tree.links, *tree.by_name}


def _value(
    tree: RobotTree, name: str, given: Mapping[str, float], locked: Mapping[str, float]
) -> float:
    joint = tree.by_name[name]
    if name in given or name in locked:
        return given.get(name, locked.get(name, 0.0))
    if joint.coupling is not None and joint.coupling.of in tree.by_name:
        source = _value(tree, joint.coupling.of, given, locked)
        return float(joint.coupling.followed(np.array([source]))[0])
    if joint.limits is not None and joint.limits[0] == joint.limits[1]:
        return joint.limits[0]
    return 0.0


def _bare(element: Element) -> Element:
    """The links and joints alone: no masses, shapes, transmissions; every joint with its limits."""
    plain = ElementTree.Element("robot", name=element.get("name") or "robot")
    for link in element.findall("link"):
        ElementTree.SubElement(plain, "link", name=link.get("name", ""))
    for joint in element.findall("joint"):
        copy = ElementTree.SubElement(plain, "joint", dict(joint.attrib))
        for kind in ("origin", "parent", "child", "axis", "limit"):
            for part in joint.findall(kind)[:1]:
                if kind == "axis" and not part.get("xyz"):  # as if it were not there
                    continue
                if kind == "limit":  # what URDF demands beside the range
                    part = Element("limit", {"effort": "0", "velocity": "0"} | part.attrib)
                copy.append(part)
        if joint.get("type") in ("revolute", "prismatic") and joint.find("limit") is None:
            ElementTree.SubElement(copy, "limit", lower="0", upper="0", effort="0", velocity="0")
    return plain


class _Pinocchio:
    def __init__(self, element: Element | None) -> None:
        assert element is not None  # of a URDF
        try:
            import pinocchio
        except ImportError as error:
            raise MissingExtraError(
                "URDF files are checked by pinocchio, which is not installed (there is none for "
                "Windows): pip install 'casadi-ik[reference]'"
            ) from error
        self._pin: Any = pinocchio
        text = ElementTree.tostring(_bare(element), encoding="unicode")
        self._model = self._pin.buildModelFromXML(text)
        self._data = self._model.createData()

    def poses(self, values: Mapping[str, float]) -> dict[str, Array]:
        q = self._pin.neutral(self._model)
        for name, value in values.items():
            if not self._model.existJointName(name):
                continue
            joint = self._model.joints[self._model.getJointId(name)]
            if joint.nq == 1:
                q[joint.idx_q] = value
            elif joint.nq == 2:  # a turn without end as cosine and sine
                q[joint.idx_q : joint.idx_q + 2] = np.cos(value), np.sin(value)
        self._pin.framesForwardKinematics(self._model, self._data, q)
        return {
            frame.name: self._data.oMf[i].homogeneous
            for i, frame in enumerate(self._model.frames)
            if frame.type == self._pin.BODY
        }


class _MuJoCo:
    def __init__(self, mujoco: Any, model: Any) -> None:
        self._mujoco, self._model = mujoco, model
        self._data = mujoco.MjData(model)

    def poses(self, values: Mapping[str, float]) -> dict[str, Array]:
        model, data = self._model, self._data
        for joint in range(model.njnt):
            name = joint_name(model, joint)
            if name in values:
                data.qpos[model.jnt_qposadr[joint]] = values[name]
        self._mujoco.mj_kinematics(model, data)
        found = {}
        for body in range(model.nbody):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
            found[model.body(body).name or f"body_{body}"] = pose
        return found
