"""Retargeter for Isaac Teleop: a tracked hand moves the arm and hand of a robot.

Written against `isaacteleop.retargeting_engine.interface` of isaacteleop 1.5 (NVIDIA/IsaacTeleop):
a `BaseRetargeter` with `input_spec`, `output_spec` and `_compute_fn`.
"""

# pyright: reportMissingImports=false
from __future__ import annotations

from typing import Any

import numpy as np

from casadi_ik.errors import optional_import
from casadi_ik.kinematics.arm_hand import ArmHand
from casadi_ik.motion.follower import Follower
from casadi_ik.motion.retarget import Retarget, Retargeter

with optional_import("integrations.isaac_teleop"):
    from isaacteleop.retargeting_engine.interface import (
        BaseRetargeter,
        OptionalType,
        TensorGroupType,
    )
    from isaacteleop.retargeting_engine.tensor_types import FloatType, HandInput, HandInputIndex


class ArmHandRetargeter(BaseRetargeter):
    """Retargeter from "hand_left" or "hand_right" (a `HandInput`) to "joints", a number per motor.

    If the hand is not tracked, or only in part, the motors decelerate to rest; a reset of the
    session restarts from their current positions.

    Example:
        >>> follower = solver.follow(q0=robot.home, period=1 / 90)
        >>> config = ik.motion.load_retarget("hand.yaml")
        >>> node = ArmHandRetargeter("arm_hand", robot, config, follower)
        >>> pipeline = node.connect({"hand_right": hands.output("hand_right")})
    """

    def __init__(
        self,
        name: str,
        robot: ArmHand,
        config: Retarget,
        follower: Follower,
        side: str = "right",
    ) -> None:
        """Store a robot and its follower.

        Args:
            name: Name of the node, unique in its pipeline.
            robot: The robot.
            config: Retargeting settings.
            follower: Follower that is called once per step; its period is the pipeline's.
            side: "right" or "left", the tracked hand.
        """
        self._robot, self._config, self._follower = robot, config, follower
        self._key, self._q = f"hand_{side}", follower.state.q
        self._weight = (config.wrist_weight, config.wrist_weight)
        self._retargeter = Retargeter(config, robot, self._q)
        super().__init__(name)

    def input_spec(self) -> dict[str, Any]:
        """Return the tracked hand, which is optional."""
        return {self._key: OptionalType(HandInput())}

    def output_spec(self) -> dict[str, Any]:
        """Return a float per motor [rad or m], by name."""
        motors = [FloatType(name) for name in self._robot.actuators]
        return {"joints": TensorGroupType("joints", motors)}

    def _compute_fn(self, inputs: dict[str, Any], outputs: dict[str, Any], context: Any) -> None:
        if context.execution_events.reset:
            self._follower.reset(self._q)
            self._retargeter = Retargeter(self._config, self._robot, self._q)
        goal = self._retargeter(_keypoints(inputs[self._key]), elapsed=self._follower.period)
        self._q = self._follower(goal.points, palm=goal.palm, palm_weight=self._weight)
        for i, value in enumerate(self._q.tolist()):
            outputs["joints"][i] = value


def _keypoints(hand: Any) -> np.ndarray:
    """Return the (26, 3) OpenXR joints [m]; NaN where the hand is not tracked."""
    keypoints = np.full((26, 3), np.nan)
    if not hand.is_none:
        valid = np.from_dlpack(hand[HandInputIndex.JOINT_VALID]).astype(bool)
        keypoints[valid] = np.from_dlpack(hand[HandInputIndex.JOINT_POSITIONS])[valid]
    return keypoints
