"""What comes next in an iteration of hand-first: constants of iteration.c, and the same without C.

Where there is no compiler, `Iteration` calls the stages' functions in CasADi's virtual machine and
decides as iteration.c does.
"""

from __future__ import annotations

from dataclasses import asdict
from importlib import resources
from typing import TYPE_CHECKING

import numpy as np

from casadi_ik.compile.codegen import define, define_arrays, number, row_major
from casadi_ik.compile.function_kernel import BufferedFunction
from casadi_ik.files.arrays import Array, spread_steps
from casadi_ik.kinematics.arms.search import ARM_SEARCH
from casadi_ik.kinematics.contact_fit import FIT, MINIMAX, TOLERANT_FIT, initial_lm_state
from casadi_ik.kinematics.contacts import LENGTH
from casadi_ik.kinematics.palm import NUMERIC_ARM_PARAMETERS, start_table
from casadi_ik.model.description import RobotDescription, Side
from casadi_ik.solve.hand_first.parameters import BODY, STAGES
from casadi_ik.solve.hand_first.state import BY_SIDE, PLACES, SAID, Stage
from casadi_ik.solve.status import Status

if TYPE_CHECKING:
    from casadi_ik.solve.hand_first.step import HandFirstStep

SIDE_STAGES = ("CANDIDATE", "HAND_FIT", "TOLERANT_HAND_FIT")
"""Stages that have a function for every side of a multi-arm robot."""

MOST_SIDES = 4
"""Of a body."""


def text(step: HandFirstStep) -> str:
    """The text of iteration.c with its constants for a robot."""
    layouts, robot = step.layouts, step.robot
    numeric = Stage.ARM_STEPS in step.stages
    whole = {
        f"{label}_{field.name.upper()}": layout.slice(field.name).start
        for label, layout in (
            ("STATE", layouts.state),
            ("PARAMETERS", layouts.parameters),
            ("SAID", SAID),
            ("RECORD", layouts.record),
        )
        for field in layout
    }
    whole |= {f"{stage.name}_STAGE": int(stage) for stage in Stage}
    whole |= {f"{status.name}_STATUS": int(status) for status in Status}
    trials = ("PLACEMENTS", "ALL_PLACEMENTS", "CHOICES", "CHOICE_PATIENCE")
    whole |= dict(zip(trials, step.trials, strict=True))
    whole |= {
        "N_SAID": SAID.size,
        "N_MOTORS": len(robot.actuators),
        "N_ARM": len(layouts.arm),
        "N_HAND": len(layouts.robot.hand_actuators),
        "N_CANDIDATES": layouts.candidates,
        "N_STARTS": len(start_table(robot)[0]) if numeric else 0,
        "MOST_STARTS": NUMERIC_ARM_PARAMETERS.starts,
        "HAS_ARM": bool(layouts.arm),
        "HAS_FAMILY": step.placements is not None,
        "HAS_CHOICE": step.choices is not None,
        "IS_COMPLETE": not numeric,
        "IS_EXACT": step.arm is not None and step.arm.is_exact,
        "NEAR_IS_SEARCHED": step.searched_if_near,
    }
    numbers = {
        "LENGTH": LENGTH,
        "FIT_DAMPING": FIT.damping,
        "FIT_GROWTH": FIT.growth,
        "SAME_COST": MINIMAX.same_cost_tolerance,
        "CLOSER": MINIMAX.improvement_ratio,
        "PROMISING": TOLERANT_FIT.max_start_ratio,
        "NEAR_MISS": TOLERANT_FIT.near_miss_ratio,
        "OWN_HAND": STAGES.own_hand,
        "WHOLE": STAGES.whole,
        "EXACT_COST": FIT.exact * FIT.exact,
        "NO_MARGIN": ARM_SEARCH.no_margin,
    }
    for name, value in asdict(BODY).items():
        (whole if isinstance(value, int) else numbers)[name.upper()] = value
    places = np.zeros(max(Stage) + 1, dtype=np.int64)
    places[list(PLACES)] = list(PLACES.values())
    arrays = {"ARM": np.array([*layouts.arm, 0]), "PLACE_OF_STAGE": places}
    whole |= {"BY_SIDE": BY_SIDE, "N_SIDES": len(robot.sides)}
    if robot.sides:
        trunk = robot.trunk_actuators
        whole["N_TRUNK"] = len(trunk)
        arrays |= {
            "TRUNK_MOTORS": np.array([*trunk, 0]),
            "TRUNK_STEPS": np.array([*spread_steps(len(trunk)), 0.0]),
            "SIDE_REACH": np.array([_reach(robot, side) for side in robot.sides]),
            "BODY_ARM_STEPS": spread_steps(len(layouts.arm)),
        }
    if numeric:
        arms, palms = start_table(robot)
        arrays |= {"START_ARMS": arms, "START_PALMS": palms.T}
    more = [f"{name}_{i}" for name in SIDE_STAGES for i in range(1, MOST_SIDES)]
    known = {stage.name for stage in step.stages}
    missing = [name for name in (*(stage.name for stage in Stage), *more) if name not in known]
    source = resources.files("casadi_ik.solve.hand_first") / "iteration.c"
    return "".join(
        (
            define({name: int(value) for name, value in whole.items()}),
            *(f"#define {name} {number(value)}\n" for name, value in numbers.items()),
            *(f"#define {name}(...) ((void) 0)\n" for name in missing),
            define_arrays(arrays),
            source.read_text(encoding="utf-8"),
        )
    )


def _reach(robot: RobotDescription, side: Side) -> float:
    """How far [m] a palm is from the base at most: the chain drawn straight, and what slides."""
    chain = robot.chain(side.palm_link)
    drawn = sum(float(np.linalg.norm(joint.placement[:3, 3])) for joint in chain)
    drawn += float(np.linalg.norm(side.palm_placement[:3, 3]))
    slid = (max(abs(j.lower), abs(j.upper)) for j in chain if j.type == "prismatic")
    return drawn + sum(slid)


class Iteration:
    """An iteration in the virtual machine.

    Attributes:
        inputs: State and parameters; write into them.
        outputs: State, record and status; a call overwrites them.
    """

    def __init__(self, step: HandFirstStep) -> None:
        """Make the arrays; functions are readied when first needed."""
        layouts = step.layouts
        self._step = step
        self._stages: dict[Stage, BufferedFunction] = {}
        self.inputs = [np.zeros(layouts.state.size), np.zeros(layouts.parameters.size)]
        self.outputs = [np.zeros(layouts.state.size), np.zeros(layouts.record.size), np.zeros(1)]
        self._x, self._p = (
            layout.unpack(array)
            for layout, array in zip((layouts.state, layouts.parameters), self.inputs, strict=True)
        )
        self._y = layouts.state.unpack(self.outputs[0])
        self._arm = list(step.robot.arm_actuators)

    def __call__(self) -> bool:
        """One iteration; False if a function reports a failure."""
        stage = Stage(int(self._x["phase"][()]))
        if stage == Stage.ARM_STEPS:
            self._begin_arm()
        call = self._stages.get(stage)
        if call is None:
            call = BufferedFunction(row_major(self._step.function(stage)))
            self._stages[stage] = call
        call.inputs[0][:], call.inputs[1][:] = self.inputs
        if stage == Stage.CANDIDATE:
            last = self._step.layouts.candidates - 1
            call.inputs[2][:] = self._p["postures"][min(int(self._x["candidate"][()]), last)]
        if not call():
            return False
        said = dict(zip(SAID.names, call.outputs[1].tolist(), strict=True))
        self.outputs[0][:], self.outputs[1][:] = call.outputs[0], call.outputs[2]
        x = {name: float(value) for name, value in self._x.items() if not value.ndim}
        status = self._followed(stage, x, self._y, said)
        self._y["counts"][PLACES[stage]] += 1
        self.outputs[1][self._step.layouts.record.slice("status")] = status
        self.outputs[2][0] = status
        return True

    def _begin_arm(self) -> None:
        """The arm begins at the next row of the table, or as it is."""
        x, p = self._x, self._p
        own = p["nearest"][()] > 0 and x["starts"][()] < 1
        if x["spent"][()] >= 1 or x["turned"][()] > 0 or own:
            return
        arms, palms = start_table(self._step.robot)
        wanted = np.concatenate([x["palm_rotation"].ravel(), x["palm_origin"] / LENGTH])
        distance = np.square(palms - wanted).sum(axis=1)
        beyond = np.where(distance > x["passed"][()], distance, np.inf)
        found = int(np.argmin(beyond if np.isfinite(beyond).any() else distance))
        x["q"][self._arm], x["passed"][()] = arms[found], distance[found]

    def _followed(
        self, stage: Stage, x: dict[str, float], y: dict[str, Array], said: dict[str, float]
    ) -> Status:
        """What iteration.c says of a stage, see there.

        Args:
            stage: It.
            x: Numbers of the state before.
            y: The state after; changed.
            said: What the stage says.
        """
        step, p = self._step, self._p
        candidates, nearest = step.layouts.candidates, p["nearest"][()] > 0
        settled, within, near = (said[name] > 0 for name in ("settled", "within", "near"))
        cost = float(y["cost"][()])

        def put(**values: float) -> None:
            for name, value in values.items():
                y[name][...] = value

        def goes_to(next_stage: Stage, status: Status = Status.RUNNING) -> Status:
            put(phase=next_stage)
            return status

        def to_next_candidate() -> Status:
            put(candidate=x["candidate"] + 1)
            return goes_to(Stage.CANDIDATE)

        def with_arm(solved: bool) -> Status:
            low, high = p["lower"][self._arm], p["upper"][self._arm]
            y["q"][self._arm] = np.clip(y["arm"], low, high)
            return goes_to(Stage.REFINEMENT, Status.SOLVED if solved else Status.RUNNING)

        def placement() -> Stage:
            complete = Stage.ARM_STEPS not in step.stages
            searched = x["earlier"] > 0 or (step.searched_if_near and nearest)
            closed = complete or (step.arm is not None and not searched)
            return Stage.ARM_PLACEMENT if closed else Stage.ARM_STEPS

        def is_new_miss(name: str) -> bool:
            if said["miss"] > TOLERANT_FIT.near_miss_ratio:
                return False
            if abs(cost - x[name]) <= MINIMAX.same_cost_tolerance * x[name]:
                put(returns=x["returns"] + 1)
                return False
            put(**{name: cost})
            return said["miss"] <= TOLERANT_FIT.max_start_ratio

        def count_return(name: str, value: float) -> None:
            put(returns=x["returns"] + (value > MINIMAX.improvement_ratio * x[name]))
            put(**{name: min(value, x[name])})

        def after_fitted_hand() -> Status:
            if not within and x["candidate"] + 1 < candidates:
                return to_next_candidate()
            ended = Status.SOLVED if within else Status.STALLED
            chooses = step.choices is not None and nearest
            following = Stage.ARM_CHOICE if chooses else placement()
            return goes_to(following, ended if p["alone"][()] > 0 else Status.RUNNING)

        match stage:
            case Stage.START:
                put(best_cost=min(said["cost"], x["best_cost"]))
                if within:
                    return Status.SOLVED
                if self._arm and said["cost"] > STAGES.whole:
                    return to_next_candidate()
                return goes_to(Stage.REFINEMENT)
            case Stage.CANDIDATE:
                if x["candidate"] < candidates:
                    return goes_to(Stage.HAND_FIT if self._arm else Stage.REFINEMENT)
                y["q"][:] = self._x["best_q"]
                return Status.STALLED
            case Stage.HAND_FIT:
                first = x["candidate"] + x["earlier"] <= 0 and x["spent"] < 1
                if candidates > 1 and nearest and first and said["cost"] > STAGES.own_hand:
                    return to_next_candidate()
                if not settled:
                    return goes_to(Stage.HAND_FIT)
                if not within and is_new_miss("near"):
                    put(**initial_lm_state())
                    return goes_to(Stage.TOLERANT_HAND_FIT)
                return after_fitted_hand()
            case Stage.TOLERANT_HAND_FIT:
                if not settled:
                    return goes_to(stage)
                if within:
                    put(near=0)
                else:
                    count_return("least_excess", cost)
                return after_fitted_hand()
            case Stage.ARM_PLACEMENT:
                if not within and y["spent"][()] < step.trials[x["earlier"] > 0]:
                    return goes_to(Stage.ARM_PLACEMENT)
                put(spent=0)
                return with_arm(within and near and x["fits"] > 0)
            case Stage.ARM_CHOICE:
                if y["spent"][()] < step.trials[2 if within else 3]:
                    return goes_to(Stage.ARM_CHOICE)
                put(spent=0)
                if not within:
                    put(margin=ARM_SEARCH.no_margin)
                    return goes_to(placement())
                return with_arm(step.arm is not None and step.arm.is_exact and x["fits"] > 0)
            case Stage.ARM_STEPS:
                exact = said["cost"] < FIT.exact * FIT.exact
                sent = int(said["at_end"]) if settled and x["earlier"] > 0 else 0
                if sent:
                    k = self._arm[sent - 1]
                    y["q"][k] = p["lower"][k] + p["upper"][k] - y["q"][k]
                put(
                    turned=sent if settled else x["turned"],
                    starts=x["starts"] + (settled and not sent),
                )
                few = settled and near and x["earlier"] < 1
                if not (exact or few or y["starts"][()] >= NUMERIC_ARM_PARAMETERS.starts):
                    return goes_to(Stage.ARM_STEPS)
                put(turned=0)
                return with_arm(exact and x["fits"] > 0)
            case Stage.REFINEMENT:
                if cost < x["best_cost"]:
                    put(best_cost=cost)
                    y["best_q"][:] = y["q"]
                if not settled:
                    return goes_to(Stage.REFINEMENT)
                if within:
                    return Status.SOLVED
                if not is_new_miss("balanced"):
                    return to_next_candidate()
                put(**initial_lm_state())
                return goes_to(Stage.TOLERANT_REFINEMENT)
            case Stage.TOLERANT_REFINEMENT:
                if not settled:
                    return goes_to(stage)
                if within:
                    return Status.SOLVED
                put(**initial_lm_state())
                return goes_to(Stage.BALANCE)
            case Stage.BALANCE:
                if within:
                    return Status.SOLVED
                if not settled:
                    return goes_to(Stage.BALANCE)
                put(**initial_lm_state(), power=0)
                count_return("least", said["cost"])
                return to_next_candidate()
        raise AssertionError(stage)
