"""Where the arm holds the grasp: an arm configuration near home that suits the scene.

The home configuration reaches to -x, so "in front of the arm" is -x. A nonlinear programme in the
seven arm joints from random starts around home; the measure that is minimised:

    |q - home|^2 / 7 + 5 |object - wished place|^2 + (1 - cos angle(palm, outward)) / 2 [forward]
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from casadi_ik.files.arrays import Array
from casadi_ik.model.objects import GraspObject
from grasp_synthesis.hand import FRAME_W, ArmHand
from grasp_synthesis.posture import Pinch
from grasp_synthesis.programme import OPTIONS
from grasp_synthesis.recipes import Recipe

LIMIT_MARGIN = np.deg2rad(10.0)
ELBOW = np.deg2rad([-105.0, -35.0])  # bent towards the object, never straight
WRIST_BEND = np.deg2rad(15.0)  # joint 6 keeps away from zero, where joints 5 and 7 align
REGION_X = {"down": (-0.65, -0.35), "forward": (-0.82, -0.60)}  # [m] where the object may be
REGION_Y = (-0.30, 0.30)
HOUSING = 0.075  # [m] radius of hand housing and wrist above the table
FINGER = 0.010  # [m] phalanx radius above the table


@dataclass(frozen=True)
class Placement:
    """An arm configuration.

    Attributes:
        arm: (7,) arm joints [rad].
        measure: The value minimised.
        conditioning: Smallest singular value of the palm's Jacobian (metres and radians).
    """

    arm: Array
    measure: float
    conditioning: float


def place(
    hand: ArmHand, item: GraspObject, recipe: Recipe, pinch: Pinch, rng: np.random.Generator
) -> list[Placement]:
    """Arm configurations for a pinch, best first.

    Args:
        hand: The arm-hand.
        item: The object.
        recipe: Says how the object is held.
        pinch: The pinch; its posture and the object's pose in the palm stay as they are.
        rng: Source of the wished place and the starts.
    """
    home = hand.robot.home[:7]
    region = np.array([*REGION_X[recipe.approach], *REGION_Y])
    wished = rng.uniform(region[::2], region[1::2])
    arm = ca.SX.sym("arm", 7)
    kin = hand.kinematics(arm, ca.SX(pinch.posture))
    palm = kin.links[FRAME_W]
    pose = palm.compose(pinch.object_in_palm)
    if recipe.up is None:
        up, height = -palm.rotation[:, 2], -item.mesh(64)[0][:, 2].min()
    else:
        direction = np.array(recipe.up)
        up, height = pose.rotation @ direction, -(item.mesh(64)[0] @ direction).min()
    equal = ca.vertcat(up[0], up[1], pose.origin[2] - height - recipe.bottom)
    face = palm.origin + 0.08 * palm.rotation[:, 2]
    heights = [kin.links["lwr_link_6"].origin[2] - HOUSING, palm.origin[2] - HOUSING]
    heights.append(face[2] - HOUSING)
    for name in ("thumb", "finger_2", "finger_3"):
        link = kin.links[f"bh_{name}_link_3"]
        heights += [
            link.origin[2] - FINGER,
            (link.origin + 0.055 * link.rotation[:, 0])[2] - FINGER,
        ]
    inequal = ca.vertcat(
        up[2] - 0.5,
        pose.origin[0] - region[0],
        region[1] - pose.origin[0],
        pose.origin[1] - region[2],
        region[3] - pose.origin[1],
        arm[5] ** 2 - WRIST_BEND**2,
        *heights,
    )
    cost = ca.sumsqr(arm - home) / 7 + 5 * ca.sumsqr(pose.origin[:2] - wished)
    if recipe.approach == "forward":
        cost += 0.5 * (1 + palm.rotation[0, 2])
    lower, upper = hand.robot.lower[:7] + LIMIT_MARGIN, hand.robot.upper[:7] - LIMIT_MARGIN
    lower[3], upper[3] = ELBOW
    solver = ca.nlpsol(
        "place", "ipopt", {"x": arm, "f": cost, "g": ca.vertcat(equal, inequal)}, OPTIONS
    )
    linear, angular = kin.twist_columns(hand.arm_names, "lwr_flange", palm.origin)
    jacobian = ca.Function("jacobian", [arm], [ca.vertcat(linear, angular)])
    placements = []
    for start in range(12):
        guess = home + 0.3 * rng.standard_normal(7)
        guess[5] *= -0.5 if start % 2 else 1.0  # both bends of the wrist
        result = solver(
            x0=np.clip(guess, lower, upper),
            lbx=lower,
            ubx=upper,
            lbg=0,
            ubg=np.concatenate([np.zeros(3), np.full(inequal.numel(), np.inf)]),
        )
        if solver.stats()["success"]:
            q = np.array(result["x"])[:, 0]
            sigma = np.linalg.svd(np.array(jacobian(q)), compute_uv=False)[-1]
            placements.append(Placement(q, float(result["f"]), float(sigma)))
    return sorted(placements, key=lambda placement: placement.measure)
