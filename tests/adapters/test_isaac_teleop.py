"""The retargeter in a pipeline of Isaac Teleop, where `isaacteleop` is installed."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik

pytest.importorskip("isaacteleop")
from isaacteleop.retargeting_engine.interface import (
    ComputeContext,
    ExecutionEvents,
    OptionalTensorGroup,
    TensorGroup,
)
from isaacteleop.retargeting_engine.tensor_types import HandInput, HandInputIndex

from casadi_ik.integrations.isaac_teleop import ArmHandRetargeter

YAML = """robot: panda+allegro_right
fingers: {thumb: 4, index: 8, middle: 12, ring: 16}
wrist_weight: 0.05
"""
RESET = ComputeContext(execution_events=ExecutionEvents(reset=True))


def tracked(positions: np.ndarray | None) -> OptionalTensorGroup:
    """Return 26 joints of OpenXR (26, 3) [m]; None means that the hand is not seen."""
    group = OptionalTensorGroup(HandInput())
    if positions is not None:
        group[HandInputIndex.JOINT_POSITIONS] = positions.astype(np.float32)
        group[HandInputIndex.JOINT_ORIENTATIONS] = np.tile([0, 0, 0, 1], (26, 1)).astype(np.float32)
        group[HandInputIndex.JOINT_RADII] = np.full(26, 0.01, np.float32)
        group[HandInputIndex.JOINT_VALID] = np.ones(26, np.uint8)
    return group


def flat_hand() -> np.ndarray:
    """An open hand in the plane x-y: wrist at 0, fingers along y."""
    poses = np.zeros((26, 3))
    for finger, begin in enumerate((2, 6, 11, 16, 21)):
        count = 4 if finger == 0 else 5
        reach = np.linspace(0.02, 0.1 if finger == 0 else 0.18, count)
        poses[begin : begin + count] = np.outer(reach, [0.3 - 0.15 * finger, 1, 0])
    return poses


def test_tracked_hand_moves_robot_and_lost_hand_stops_it(tmp_path):
    (tmp_path / "hand.yaml").write_text(YAML)
    robot = ik.load_robot("panda+allegro_right")
    follower = ik.Solver(robot).follow(robot.home, period=0.01)
    config = ik.motion.load_retarget(tmp_path / "hand.yaml")
    node = ArmHandRetargeter("arm_hand", robot, config, follower)
    assert [joint.name for joint in node.output_types()["joints"].types] == list(robot.actuators)

    def q(hand: OptionalTensorGroup, context: ComputeContext | None = None) -> np.ndarray:
        out: TensorGroup = node({"hand_right": hand}, context)["joints"]
        return np.array([out[i] for i in range(len(robot.actuators))])

    q_lost = q(tracked(None))
    np.testing.assert_allclose(q_lost, robot.home, atol=1e-6)
    hand = flat_hand()
    begin = q(tracked(hand))
    bent = hand.copy()
    bent[[10, 9]] += [[0, -0.05, -0.04], [0, -0.02, -0.03]]  # the index finger
    for _ in range(100):
        q_bent = q(tracked(bent))
    step = np.abs(q_bent - begin)
    index = [
        i for i, name in enumerate(robot.actuators) if robot.description.actuators[i].part == "hand"
    ]
    assert step[index].max() > 0.1
    assert (np.abs(q_bent - robot.lower) >= -1e-9).all()
    for _ in range(100):
        q_bent = q(tracked(None))
    np.testing.assert_allclose(q(tracked(None)), q_bent, atol=1e-9)
    np.testing.assert_allclose(q(tracked(None), RESET), q_bent, atol=1e-9)
