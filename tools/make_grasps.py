"""Compute the built-in grasps: a Barrett posture that pinches each object, held by the arm.

Run it again whenever an object, the hand or the recipes change::

    python tools/make_grasps.py                 # all twelve into models/grasps
    python tools/make_grasps.py --only cup
    python tools/make_grasps.py --check         # verify the files that are there

The pinch is a nonlinear programme in hand posture and object pose (`grasp_synthesis.posture`), the
place in front of the arm another (`grasp_synthesis.placement`); both take random starts from one
seed, and the best by the stated measure that keeps clear of palm and phalanges is written. Of
several places the first is taken that `enhanced-dls` solves from home (see `scene`).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from grasp_synthesis.clearance import Clearance, clearance
from grasp_synthesis.hand import ROBOT, ArmHand
from grasp_synthesis.placement import Placement, place
from grasp_synthesis.posture import Pinch, PinchProblem
from grasp_synthesis.recipes import RECIPES, Recipe
from grasp_synthesis.verify import BETWEEN_GAP, FINGER_GAP, PALM_GAP, problems
from grasp_synthesis.writing import barrett_text

import casadi_ik as ik
from casadi_ik.files.shipped import models_folder
from casadi_ik.model.objects import GraspObject, load_object

PLACES = 20  # places tried per pinch
MIN_CONDITIONING = 0.10  # smallest singular value of the palm's Jacobian (metres, radians)


def main(arguments: list[str] | None = None) -> int:
    """Write or check the grasps; return 0 if all are valid."""
    parser = argparse.ArgumentParser(description="Compute the shipped grasps.")
    parser.add_argument("--only", choices=[r.name for r in RECIPES], help="one object")
    parser.add_argument("--check", action="store_true", help="verify the files, write nothing")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--starts", type=int, default=30, help="random starts per pinch")
    parser.add_argument("--out", type=Path, default=models_folder() / "grasps")
    options = parser.parse_args(arguments)
    hand, good = ArmHand(), True
    for index, recipe in enumerate(RECIPES):
        if options.only not in (None, recipe.name):
            continue
        path = options.out / f"{recipe.name}.yaml"
        if not options.check:
            rng = np.random.default_rng([options.seed, index])
            text = make(hand, recipe, rng, options.starts, options.seed)
            if text is None:
                print(f"{recipe.name}: no grasp found")
                good = False
                continue
            path.write_text(text, encoding="utf-8")
        wrong = problems(hand, path)
        print(f"{recipe.name}: {'; '.join(wrong) or 'good'}")
        good = good and not wrong
    return 0 if good else 1


def make(
    hand: ArmHand, recipe: Recipe, rng: np.random.Generator, starts: int, seed: int
) -> str | None:
    """Return the text of a grasp file; None if no grasp was found."""
    item = load_object(recipe.name)
    for pinch in PinchProblem(hand, item, recipe).solve(rng, starts):
        gaps = pinch_gaps(hand, item, pinch)
        if (
            gaps.palm < PALM_GAP
            or gaps.fingers < FINGER_GAP
            or gaps.between < BETWEEN_GAP
            or pinch.residual > 1e-9
        ):
            continue
        placement = scene(hand, item, recipe, pinch, rng)
        if placement is not None:
            report(pinch, placement, gaps)
            return barrett_text(hand, recipe, pinch, placement, gaps, seed)
    return None


def scene(
    hand: ArmHand, item: GraspObject, recipe: Recipe, pinch: Pinch, rng: np.random.Generator
) -> Placement | None:
    """Return the first valid placement, preferably one that the paper's method solves from home.

    A shipped grasp is a worked example, so a place is taken where there is something to see. It
    says nothing about success rates: the studies measure those on random arm configurations.
    """
    solver = ik.Solver(ik.load_robot(ROBOT), "enhanced-dls", finger_step="closed-form")
    first = None
    for _ in range(PLACES):
        placement = best_placement(place(hand, item, recipe, pinch, rng))
        if placement is None:
            continue
        first = first or placement
        _, points, normals, _, _ = hand.evaluate(placement.arm, pinch.posture)
        if solver.solve_batch(points[None], normals[None]).success[0]:
            return placement
    return first


def pinch_gaps(hand: ArmHand, item: GraspObject, pinch: Pinch) -> Clearance:
    """Return the gaps of a pinch."""
    palm, _, _, lines, _ = hand.evaluate(np.zeros(7), pinch.posture)
    return clearance(item, pinch.object_in_palm, (lines - palm[:3, 3]) @ palm[:3, :3])


def best_placement(placements: list[Placement]) -> Placement | None:
    """Return the first pinch away from singularities."""
    return next((p for p in placements if p.conditioning > MIN_CONDITIONING), None)


def report(pinch: Pinch, placement: Placement, gaps: Clearance) -> None:
    """Return a line of numbers."""
    posture = " ".join(f"{value:6.2f}" for value in np.rad2deg(pinch.posture))
    arm = " ".join(f"{value:7.2f}" for value in np.rad2deg(placement.arm))
    millimetres = " ".join(f"{1e3 * gap:.1f}" for gap in (gaps.palm, gaps.fingers, gaps.between))
    print(
        f"  posture [deg] {posture} | friction {abs(pinch.friction):.3f} | gaps [mm] {millimetres} "
        f"| arm [deg] {arm} "
        f"| conditioning {placement.conditioning:.3f}"
    )


if __name__ == "__main__":
    sys.exit(main())
