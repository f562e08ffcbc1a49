"""A comparison of an imported robot with the kinematics of pinocchio (URDF) or MuJoCo (MJCF)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from casadi_ik.errors import MissingExtraError
from casadi_ik.files.arrays import Array
from casadi_ik.integrations.importing.robot_shapes import hand_links, name_in_robot
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.model.urdf_mjcf import joint_name
from casadi_ik.model.xml_tree import RobotTree


def largest_difference(
    robot: ArmHand,
    tree: RobotTree,
    q: Array,
    locked: Mapping[str, float] | None = None,
    arm_tree: RobotTree | None = None,
    hand_tree: RobotTree | None = None,
) -> float:
    """Return the largest difference between link poses of a robot and of the reference library.

    Args:
        robot: The robot, imported from the file alone or as a part.
        tree: The file.
        q: (k, n) positions of the actuators [rad or m].
        locked: Positions of the joints that the description fixes [rad or m].
        arm_tree: File of the arm that carries the hand of `tree`; names of the hand that the arm
            has, too, are prefixed in the robot.
        hand_tree: File of the hand that the arm of `tree` carries; a name that it shares with the
            arm may be a link beyond the arm's tip, which the robot does not have.

    Returns:
        The largest entry of the difference of any two poses, relative to the first link of the
        file that the robot has.

    Raises:
        MissingExtraError: The reference library is not installed.
    """
    reference: _ReferenceModel = (
        _MuJoCoModel(*tree.model) if tree.model is not None else _PinocchioModel(tree.element)
    )
    shared_names = set() if arm_tree is None else {*arm_tree.links, *arm_tree.by_name}
    links = {
        link: name_in_robot(link, robot.description.links, shared_names) for link in tree.links
    }
    if arm_tree is not None or hand_tree is not None:
        hand = hand_links(robot.description)
        is_arm = hand_tree is not None
        links = {link: name for link, name in links.items() if (name in hand) != is_arm}
    joints = {
        joint.name: name_in_robot(joint.name, robot.description.joint_names, shared_names)
        for joint in tree.joints
    }
    largest = 0.0
    for configuration in q:
        robot_positions = robot.joints(configuration)
        positions = dict(locked or {}) | {
            name: robot_positions[robot_name]
            for name, robot_name in joints.items()
            if robot_name in robot_positions
        }
        reference_poses = reference.link_poses(
            {name: _joint_position(tree, name, positions) for name in tree.by_name}
        )
        robot_poses = robot.links(configuration)
        pairs = [
            (reference_poses[link], robot_poses[robot_link])
            for link, robot_link in links.items()
            if robot_link in robot_poses and link in reference_poses
        ]
        reference_inverse, robot_inverse = (np.linalg.inv(pose) for pose in pairs[0])
        for reference_pose, robot_pose in pairs:
            difference = reference_inverse @ reference_pose - robot_inverse @ robot_pose
            largest = max(largest, float(np.abs(difference).max()))
    return largest


def _joint_position(tree: RobotTree, name: str, positions: Mapping[str, float]) -> float:
    """Return the position of a joint: from `positions`, its coupling, or its only possible one."""
    joint = tree.by_name[name]
    if name in positions:
        return positions[name]
    if joint.coupling is not None and joint.coupling.of in tree.by_name:
        leader = _joint_position(tree, joint.coupling.of, positions)
        return float(joint.coupling.joint_position(np.array([leader]))[0])
    if joint.limits is not None and joint.limits[0] == joint.limits[1]:
        return joint.limits[0]
    return 0.0


class _ReferenceModel(Protocol):
    """A model of the reference library."""

    def link_poses(self, positions: Mapping[str, float]) -> dict[str, Array]:
        """Return the pose (4, 4) of every link at joint positions [rad or m]."""
        ...


class _PinocchioModel:
    """Forward kinematics of a URDF file by pinocchio."""

    def __init__(self, element: Element | None) -> None:
        assert element is not None  # of a URDF
        try:
            import pinocchio
        except ImportError as error:
            raise MissingExtraError(
                "URDF files are checked by pinocchio, which is not installed (it is not available "
                "for Windows): pip install 'casadi-ik[reference]'"
            ) from error
        self._pin: Any = pinocchio
        text = ElementTree.tostring(_kinematic_urdf(element), encoding="unicode")
        self._model = self._pin.buildModelFromXML(text)
        self._data = self._model.createData()

    def link_poses(self, positions: Mapping[str, float]) -> dict[str, Array]:
        """Return the pose (4, 4) of every link for positions of joints by name."""
        q = self._pin.neutral(self._model)
        for name, position in positions.items():
            if not self._model.existJointName(name):
                continue
            joint = self._model.joints[self._model.getJointId(name)]
            if joint.nq == 1:
                q[joint.idx_q] = position
            elif joint.nq == 2:  # a continuous joint as cosine and sine
                q[joint.idx_q : joint.idx_q + 2] = np.cos(position), np.sin(position)
        self._pin.framesForwardKinematics(self._model, self._data, q)
        return {
            frame.name: self._data.oMf[i].homogeneous
            for i, frame in enumerate(self._model.frames)
            if frame.type == self._pin.BODY
        }


class _MuJoCoModel:
    """Forward kinematics of an MJCF file by MuJoCo."""

    def __init__(self, mujoco: Any, model: Any) -> None:
        self._mujoco, self._model = mujoco, model
        self._data = mujoco.MjData(model)

    def link_poses(self, positions: Mapping[str, float]) -> dict[str, Array]:
        """Return the pose (4, 4) of every body for positions of joints by name."""
        model, data = self._model, self._data
        for joint in range(model.njnt):
            name = joint_name(model, joint)
            if name in positions:
                data.qpos[model.jnt_qposadr[joint]] = positions[name]
        self._mujoco.mj_kinematics(model, data)
        poses = {}
        for body in range(model.nbody):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
            poses[model.body(body).name or f"body_{body}"] = pose
        return poses


def _kinematic_urdf(element: Element) -> Element:
    """Return a URDF that has only links and joints, where pinocchio requires limits of joints."""
    urdf = ElementTree.Element("robot", name=element.get("name") or "robot")
    for link in element.findall("link"):
        ElementTree.SubElement(urdf, "link", name=link.get("name", ""))
    for joint in element.findall("joint"):
        copy = ElementTree.SubElement(urdf, "joint", dict(joint.attrib))
        for kind in ("origin", "parent", "child", "axis", "limit"):
            for child in joint.findall(kind)[:1]:
                if kind == "axis" and not child.get("xyz"):  # an empty axis means the default
                    continue
                if kind == "limit":  # URDF requires effort and velocity
                    child = Element("limit", {"effort": "0", "velocity": "0"} | child.attrib)
                copy.append(child)
        if joint.get("type") in ("revolute", "prismatic") and joint.find("limit") is None:
            ElementTree.SubElement(copy, "limit", lower="0", upper="0", effort="0", velocity="0")
    return urdf
