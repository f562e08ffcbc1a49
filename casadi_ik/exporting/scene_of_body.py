"""The same for a body: several arms, or arms on a trunk."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from casadi_ik.arms.family import ArmFamily
from casadi_ik.arms.search import arms_graph
from casadi_ik.arrays import Array, even_steps
from casadi_ik.exporting.scene import SceneSources
from casadi_ik.kernels.codegen import define, define_arrays, number
from casadi_ik.kernels.function_kernel import FunctionKernel
from casadi_ik.kernels.graphs import FunctionGraph
from casadi_ik.methods.hand_first.body import BodyStep
from casadi_ik.solving.finder import side_links
from casadi_ik.solving.free import PARAMETERS as FREE
from casadi_ik.solving.trials import AT_ENDS, CARRYING, PALMS


@dataclass(frozen=True, eq=False)
class BodySceneSources(SceneSources):
    """What a scene adds to the sources of a body's solver.

    Pairs of shapes stand in the order of what decides how far they are apart: a hand alone, side
    after side; the same with idle fingers; the trunk, or several palms; an arm, with those before.
    """

    @cached_property
    def step(self) -> BodyStep:
        """The step of its method."""
        assert isinstance(self.method.step, BodyStep)
        return self.method.step

    @property
    def _families(self) -> list[tuple[ArmFamily | None, tuple[int, ...]]]:
        return [(side.family, side.arm) for side in self.step.sides]

    @property
    def maps(self) -> dict[str, FunctionKernel | FunctionGraph]:
        """Where the palms are, and the arms in closed form of each side."""
        arms = {
            f"arms_{i}": arms_graph(arm.family, "all_arms", "")
            for i, arm in enumerate(self.closed_arms)
        }
        return {"palm": self.step.palms(), **arms}

    @property
    def kind(self) -> dict[str, str]:
        """What stands for the marks that say how many arms there are."""
        count = len(self.step.sides)
        return {
            "BODY": "",
            "CAPSULE_PART": "part_of(MOVING[i], idle && idle[LINK[i]])",
            "PAIR_PART": "part_of(PAIR_MOVING[k], idle && (idle[first] || idle[other]))",
            "ARMS_OF_SIDES": self._arms_of_sides(),
            "SIDES": str(count),
            "PARTS_OF_PAIRS": str(3 * count + 1),
            "MOST_TRUNKS": str(sum(trunks for trunks, _ in FREE.trunks)),
        }

    @property
    def begun(self) -> str:
        """What happens to the scene where a target is taken up."""
        return f"{super().begun}  solver->scene.listed = 0;\n"

    @property
    def own_jobs(self) -> str:
        """What finds hands and arms that are free."""
        solver, bounds = f"{self.prefix}_solver *solver", "const scalar *lower, const scalar *upper"
        return (
            f"void {self.prefix}_list_pairs({solver}, {bounds});\n"
            f"int {self.prefix}_side_is_free({solver}, int side, const scalar *q);\n"
            f"int {self.prefix}_arms_are_free({solver}, {bounds}, int near, const scalar *palms, "
            "scalar *q);\n"
        )

    def decided_by(self, *links: str) -> int:
        """The part of the list of pairs in which one of these links is, idle fingers aside."""
        count, sides = len(self.step.sides), side_links(self.robot.description)
        arms = [i for i, (arm, _) in enumerate(sides) if not arm.isdisjoint(links)]
        if arms:
            return 2 * count + 1 + arms[-1]
        moved = {link for link in links if not self.model.is_fixed(link)}
        own = [i for i, (_, hand) in enumerate(sides) if moved <= hand]
        return own[0] if own else 2 * count

    def arm_constants(self) -> tuple[dict[str, int], str, dict[str, Array]]:
        """How many there are: what is known of each stands in a table of its own."""
        return {}, "", {}

    def look_constants(self) -> str:
        """What the search for free hands, trunks and arms knows."""
        state = self.step.layouts.state
        motors = [*self.robot.description.trunk_actuators, *self.step.layouts.arm]
        carry: dict[int, float] = {}
        for name, value in (CARRYING | {"side": float(len(self.step.sides))}).items():
            place = state.slice(name)
            carry |= dict.fromkeys(range(place.start, place.stop), value)
        places = {
            "STATE_FIRST": state.slice("first").start,
            "STATE_PALMS": state.slice("palm_rotation_0").start,
            "N_CARRY": len(carry),
            "N_CARRYING": len(motors),
            "N_LOTS": len(FREE.trunks),
        }
        reals = {"PALM_TURN": PALMS[0], "PALM_SHIFT": PALMS[3], "TRUNK_AT_ENDS": AT_ENDS}
        arrays = {
            "LOTS": np.array(FREE.trunks),
            "CARRY_PLACES": np.array(list(carry)),
            "CARRY_VALUES": np.array(list(carry.values())),
            "CARRYING": np.array(motors),
            "CARRYING_STEPS": even_steps(len(motors)),
        }
        return (
            super().look_constants()
            + define(places)
            + "".join(f"#define {name} {number(float(value))}\n" for name, value in reals.items())
            + define_arrays(arrays)
        )

    def _arms_of_sides(self) -> str:
        """A table of the arms."""
        text = rows = ""
        for i, arm in enumerate(self.closed_arms):
            n = arm.sizes
            arrays = {f"{k}_{i}": array for k, array in arm.arrays.items() if k != "CLOSER"}
            columns = ", ".join(map(str, arm.columns))
            text += define_arrays(arrays) + f"static const int64_t COLUMNS_{i}[] = {{{columns}}};\n"
            rows += (
                f"  {{{self.prefix}_arms_{i}_kernel, {n['N_ARM']}, {n['N_REDUNDANCY']}, "
                f"{n['N_ROWS']}, {{{n['N_PLACES']}, {n['N_MORE_PLACES']}}},\n"
                f"   {{PLACES_{i}, MORE_PLACES_{i}}}, ARM_LOW_{i}, ARM_RANGE_{i}, COLUMNS_{i}}},\n"
            )
        if not rows:
            return ""
        most = {
            f"MOST_{name}": max(arm.sizes[f"N_{name}"] for arm in self.closed_arms)
            for name in ("ARM", "ROWS")
        }
        return define(most) + text + f"static const arm_of_side ARMS[] = {{\n{rows}}};\n"
