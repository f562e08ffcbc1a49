"""Collision sources of exported solvers for robots with several arms, or with arms on a trunk."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from casadi_ik.compile.codegen import define, define_arrays, number
from casadi_ik.compile.function_kernel import FunctionKernel
from casadi_ik.compile.graphs import FunctionGraph
from casadi_ik.export.scene import SceneSources
from casadi_ik.files.arrays import Array, spread_steps
from casadi_ik.kinematics.arms.family import ArmFamily
from casadi_ik.kinematics.arms.search import ARM_SEARCH, arms_graph
from casadi_ik.solve.alternatives import side_links
from casadi_ik.solve.collision_free_steps import COLLISION_FREE_PARAMETERS
from casadi_ik.solve.hand_first.multi_arm import MultiArmStep
from casadi_ik.solve.subproblems import TRUNK_STRETCH


@dataclass(frozen=True, eq=False)
class MultiArmSceneSources(SceneSources):
    """Additions to the sources of a solver that checks collisions of a multi-arm robot.

    Pairs of shapes are sorted into groups by the motors that determine their distance: a hand
    without its idle fingers, by side; idle fingers, by side; the trunk or several palms; an arm
    and the arms of earlier sides, by side.
    """

    @cached_property
    def step(self) -> MultiArmStep:
        """Step of the method, with the data of its sides."""
        assert isinstance(self.method.step, MultiArmStep)
        return self.method.step

    @property
    def _families(self) -> list[tuple[ArmFamily | None, tuple[int, ...]]]:
        return [(side.family, side.arm) for side in self.step.sides]

    @property
    def maps(self) -> dict[str, FunctionKernel | FunctionGraph]:
        """Graphs of the poses of palms, and of each side's arms in closed form, by name."""
        arms = {
            f"arms_{i}": arms_graph(arm.family, "all_arms", "")
            for i, arm in enumerate(self.closed_arms)
        }
        return {"palm": self.step.palms(), **arms}

    @property
    def arm_marks(self) -> dict[str, str]:
        """Substitutes that depend on the number of arms."""
        count = len(self.step.sides)
        return {
            "BODY": "",
            "CAPSULE_GROUP": "pair_group(MOVING[i], is_idle && is_idle[LINK[i]])",
            "PAIR_GROUP": (
                "pair_group(PAIR_MOVING[k],\n"
                "                   is_idle && (is_idle[first_link] || is_idle[second_link]))"
            ),
            "ARMS_OF_SIDES": self._arms_of_sides(),
            "SIDES": str(count),
            "PAIR_GROUPS": str(3 * count + 1),
            "MAX_TRUNK_TRIALS": str(
                sum(trunks for trunks, _ in COLLISION_FREE_PARAMETERS.trunk_stages)
            ),
        }

    @property
    def begin(self) -> str:
        """Statements that reset the search of the scene for a new target."""
        return f"{super().begin}  solver->scene.has_pair_list = 0;\n"

    @property
    def arm_jobs(self) -> str:
        """Declarations of the functions that check hands and choose collision-free arms."""
        solver, bounds = f"{self.prefix}_solver *solver", "const scalar *lower, const scalar *upper"
        return (
            f"void {self.prefix}_list_pairs({solver}, {bounds});\n"
            f"int {self.prefix}_side_is_free({solver}, int side, const scalar *q);\n"
            f"int {self.prefix}_arms_are_free({solver}, {bounds}, int prefer_q0,\n"
            "    const scalar *palms, scalar *q);\n"
        )

    def pair_group(self, *links: str) -> int:
        """Return the group of a link or of a pair of links, if no finger is idle."""
        count, sides = len(self.step.sides), side_links(self.robot.description)
        arm_sides = [i for i, (arm, _) in enumerate(sides) if not arm.isdisjoint(links)]
        if arm_sides:
            return 2 * count + 1 + arm_sides[-1]
        movable = {link for link in links if not self.model.is_fixed(link)}
        hand_sides = [i for i, (_, hand) in enumerate(sides) if movable <= hand]
        return hand_sides[0] if hand_sides else 2 * count

    def arm_constants(self) -> tuple[dict[str, int], str, dict[str, Array]]:
        """Return nothing: the table of `_arms_of_sides` describes the arms."""
        return {}, "", {}

    def search_constants(self) -> str:
        """Return the constants of the search for collision-free hands, trunks and arms."""
        state, parameters = self.step.layouts.state, self.step.layouts.parameters
        motors = [*self.robot.description.trunk_actuators, *self.step.layouts.arm]
        integers = {
            "STATE_FIRST_CANDIDATE": state.slice("first_candidate").start,
            "STATE_PALMS": state.slice("palm_rotation_0").start,
            "STATE_MEETS_CONTACTS": state.slice("meets_contacts").start,
            "STATE_ARM_MARGIN": state.slice("arm_margin").start,
            "PARAMETERS_PALMS_ONLY": parameters.slice("palms_only").start,
            "N_TRUNK_AND_ARMS": len(motors),
            "N_TRUNK_STAGES": len(COLLISION_FREE_PARAMETERS.trunk_stages),
        }
        arrays = {
            "TRUNK_STAGES": np.array(COLLISION_FREE_PARAMETERS.trunk_stages),
            "TRUNK_AND_ARMS": np.array(motors),
            "TRUNK_AND_ARM_STEPS": spread_steps(len(motors)),
        }
        return (
            super().search_constants()
            + define(integers)
            + f"#define TRUNK_STRETCH {number(TRUNK_STRETCH)}\n"
            + f"#define NO_MARGIN {number(ARM_SEARCH.no_margin)}\n"
            + define_arrays(arrays)
        )

    def _arms_of_sides(self) -> str:
        """Return the definition of the table of arms by side; empty without closed forms."""
        text = rows = ""
        for i, arm in enumerate(self.closed_arms):
            n = arm.sizes
            arrays = {
                f"{name}_{i}": array
                for name, array in arm.arrays.items()
                if name != "SAMPLE_OFFSETS"
            }
            columns = ", ".join(map(str, arm.columns))
            text += define_arrays(arrays) + f"static const int64_t COLUMNS_{i}[] = {{{columns}}};\n"
            rows += (
                f"  {{{self.prefix}_arms_{i}_kernel, {n['N_ARM']}, {n['N_REDUNDANCY']}, "
                f"{n['N_ROWS']}, {{{n['N_SAMPLES']}, {n['N_MORE_SAMPLES']}}},\n"
                f"   {{SAMPLES_{i}, MORE_SAMPLES_{i}}}, ARM_LOW_{i}, ARM_RANGE_{i}, "
                f"COLUMNS_{i}}},\n"
            )
        if not rows:
            return ""
        max_sizes = {
            f"MAX_{name}": max(arm.sizes[f"N_{name}"] for arm in self.closed_arms)
            for name in ("ARM", "ROWS")
        }
        return define(max_sizes) + text + f"static const side_arm ARMS[] = {{\n{rows}}};\n"
