"""Iteration of hand-first: the C text for a robot, and its equivalent without a compiler.

Without a compiler, `VirtualIteration` evaluates the graphs of the stages in CasADi's virtual
machine, and chooses the next stage as iteration.c and one_arm.c do.
"""

from __future__ import annotations

from dataclasses import asdict
from importlib import resources

import casadi as ca
import numpy as np

from casadi_ik.compile.codegen import Stages, define, define_arrays, number, row_major
from casadi_ik.compile.function_kernel import BufferedFunction
from casadi_ik.compile.graphs import StepGraph, recipe
from casadi_ik.files.arrays import Array, spread_steps
from casadi_ik.kinematics.arms.search import ARM_SEARCH
from casadi_ik.kinematics.contact_fit import FIT, TOLERANT_FIT, initial_lm_state
from casadi_ik.kinematics.contacts import LENGTH, kinds_suffix
from casadi_ik.kinematics.minimax import MINIMAX
from casadi_ik.kinematics.palm import NUMERIC_ARM_PARAMETERS, start_table
from casadi_ik.model.description import RobotDescription, Side
from casadi_ik.model.multi_arm import MAX_SIDES
from casadi_ik.solve.hand_first.parameters import STAGE_PARAMETERS, TRUNK_PARAMETERS
from casadi_ik.solve.hand_first.state import COUNTER_OF_STAGE, SIDE_OFFSET, STAGE_RESULT, Stage
from casadi_ik.solve.hand_first.step import HandFirstStep
from casadi_ik.solve.status import Status

SIDE_STAGES = ("CANDIDATE", "HAND_FIT", "TOLERANT_HAND_FIT")
"""Stages with a graph for each side of a multi-arm robot."""


def iteration_graph(step: HandFirstStep) -> StepGraph:
    """Return the graph of an iteration."""
    layouts = step.layouts
    name = ca.Function.fix_name(f"hand_first_{step.robot.name}{kinds_suffix(layouts.kinds)}")
    return StepGraph(
        name,
        lambda: Stages({stage: step.function(stage) for stage in step.stages}, c_text(step)),
        layouts.state,
        layouts.parameters,
        layouts.record,
        stage="phase",
        recipe=recipe(name, step.robot, layouts.candidates, layouts.kinds),
        c_only="postures",
        virtual=lambda: VirtualIteration(step),
    )


def c_text(step: HandFirstStep) -> str:
    """Return the C text of the iteration with its constants for a robot."""
    stage_names = {stage.name for stage in step.stages}
    all_names = [stage.name for stage in Stage]
    all_names += [f"{name}_{i}" for name in SIDE_STAGES for i in range(1, MAX_SIDES)]
    missing = [name for name in all_names if name not in stage_names]
    files = ("lane.c", "multi_arm.c" if step.robot.sides else "one_arm.c", "iteration.c")
    folder = resources.files("casadi_ik.solve.hand_first")
    return "".join(
        (
            define(_integers(step)),
            *(f"#define {name} {number(value)}\n" for name, value in _real_numbers().items()),
            *(f"#define {name}(...) ((void) 0)\n" for name in missing),
            define_arrays(_arrays(step)),
            *((folder / file).read_text(encoding="utf-8") for file in files),
        )
    )


def _integers(step: HandFirstStep) -> dict[str, int]:
    """Return the integer constants: offsets of fields, codes of stages, counts."""
    layouts, robot = step.layouts, step.robot
    is_numeric = Stage.ARM_STEPS in step.stages
    offsets = {
        f"{label}_{field.name.upper()}": layout.slice(field.name).start
        for label, layout in (
            ("STATE", layouts.state),
            ("PARAMETERS", layouts.parameters),
            ("RESULT", STAGE_RESULT),
            ("RECORD", layouts.record),
        )
        for field in layout
    }
    codes = {f"{stage.name}_STAGE": int(stage) for stage in Stage}
    codes |= {f"{status.name}_STATUS": int(status) for status in Status}
    trial_names = ("PLACEMENTS", "LATER_PLACEMENTS", "CHOICES", "FAILED_CHOICES")
    counts = {
        "N_RESULTS": STAGE_RESULT.size,
        "N_MOTORS": len(robot.actuators),
        "N_ARM": len(layouts.arm),
        "N_HAND": len(layouts.robot.hand_actuators),
        "N_CANDIDATES": layouts.candidates,
        "N_SIDES": len(robot.sides),
        "N_STARTS": len(start_table(robot)[0]) if is_numeric else 0,
        "MAX_STARTS": NUMERIC_ARM_PARAMETERS.starts,
        "SIDE_OFFSET": SIDE_OFFSET,
        "HAS_ARM": int(bool(layouts.arm)),
        "HAS_FAMILY": int(step.placements is not None),
        "HAS_CHOICE": int(step.choices is not None),
        "IS_COMPLETE": int(not is_numeric),
        "IS_EXACT": int(step.arm is not None and step.arm.is_exact),
        "USES_STEPS_NEAR_Q0": int(step.uses_steps_near_q0),
    }
    if robot.sides:
        counts["N_TRUNK"] = len(robot.trunk_actuators)
    trunk = {k.upper(): v for k, v in asdict(TRUNK_PARAMETERS).items() if isinstance(v, int)}
    return offsets | codes | dict(zip(trial_names, step.trials, strict=True)) | counts | trunk


def _real_numbers() -> dict[str, float]:
    stages = {name.upper(): value for name, value in asdict(STAGE_PARAMETERS).items()}
    trunk = {k.upper(): v for k, v in asdict(TRUNK_PARAMETERS).items() if isinstance(v, float)}
    return {
        "LENGTH": LENGTH,
        "FIT_DAMPING": FIT.damping,
        "FIT_GROWTH": FIT.growth,
        "SAME_COST": MINIMAX.same_cost_tolerance,
        "IMPROVEMENT_RATIO": MINIMAX.improvement_ratio,
        "MAX_START_RATIO": TOLERANT_FIT.max_start_ratio,
        "NEAR_MISS_RATIO": TOLERANT_FIT.near_miss_ratio,
        "EXACT_COST": FIT.exact * FIT.exact,
        "NO_MARGIN": ARM_SEARCH.no_margin,
        **stages,
        **trunk,
    }


def _arrays(step: HandFirstStep) -> dict[str, Array]:
    """Return the constant arrays; each has a zero at its end, since C has no empty arrays."""
    layouts, robot = step.layouts, step.robot
    counters = np.zeros(max(Stage) + 1, dtype=np.int64)
    counters[list(COUNTER_OF_STAGE)] = list(COUNTER_OF_STAGE.values())
    arrays = {"ARM": np.array([*layouts.arm, 0]), "COUNTER_OF_STAGE": counters}
    if robot.sides:
        trunk = robot.trunk_actuators
        arrays |= {
            "TRUNK_MOTORS": np.array([*trunk, 0]),
            "TRUNK_STEPS": np.array([*spread_steps(len(trunk)), 0.0]),
            "SIDE_REACH": np.array([_stretched_length(robot, side) for side in robot.sides]),
            "ARM_STEPS_OF_TRIAL": spread_steps(len(layouts.arm)),
        }
    if Stage.ARM_STEPS in step.stages:
        arms, palms = start_table(robot)
        arrays |= {"START_ARMS": arms, "START_PALMS": palms.T}
    return arrays


def _stretched_length(robot: RobotDescription, side: Side) -> float:
    """Return an upper bound of the distance [m] of a palm from the base: all links in a line."""
    chain = robot.chain(side.palm_link)
    length = sum(float(np.linalg.norm(joint.placement[:3, 3])) for joint in chain)
    length += float(np.linalg.norm(side.palm_placement[:3, 3]))
    strokes = (max(abs(j.lower), abs(j.upper)) for j in chain if j.type == "prismatic")
    return length + sum(strokes)


class VirtualIteration:
    """An iteration in the virtual machine, for a robot with one hand.

    Attributes:
        inputs: State and parameters; write into them.
        outputs: State, record and status; a call overwrites them.
    """

    def __init__(self, step: HandFirstStep) -> None:
        """Allocate the arrays; graphs are prepared when first needed."""
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
        """Run one iteration; return False if a graph reports a failure."""
        stage = Stage(int(self._x["phase"][()]))
        if stage == Stage.ARM_STEPS:
            self._start_arm_steps()
        graph = self._stages.get(stage)
        if graph is None:
            graph = BufferedFunction(row_major(self._step.function(stage)))
            self._stages[stage] = graph
        graph.inputs[0][:], graph.inputs[1][:] = self.inputs
        if stage == Stage.CANDIDATE:
            last = self._step.layouts.candidates - 1
            graph.inputs[2][:] = self._p["postures"][min(int(self._x["candidate"][()]), last)]
        if not graph():
            return False
        results = dict(zip(STAGE_RESULT.names, graph.outputs[1].tolist(), strict=True))
        self.outputs[0][:], self.outputs[1][:] = graph.outputs[0], graph.outputs[2]
        x = {name: float(value) for name, value in self._x.items() if not value.ndim}
        status = self._choose_stage(stage, x, self._y, results)
        self._y["counts"][COUNTER_OF_STAGE[stage]] += 1
        self.outputs[1][self._step.layouts.record.slice("status")] = status
        self.outputs[2][0] = status
        return True

    def _start_arm_steps(self) -> None:
        """Start the arm as `before_arm_steps` of one_arm.c does."""
        x, p = self._x, self._p
        starts_at_q0 = p["nearest"][()] > 0 and x["arm_starts"][()] < 1
        if x["stage_iterations"][()] >= 1 or x["arm_flipped_joint"][()] > 0 or starts_at_q0:
            return
        arms, palms = start_table(self._step.robot)
        palm = np.concatenate([x["palm_rotation"].ravel(), x["palm_origin"] / LENGTH])
        distance = np.square(palms - palm).sum(axis=1)
        farther = np.where(distance > x["arm_start_distance"][()], distance, np.inf)
        entry = int(np.argmin(farther if np.isfinite(farther).any() else distance))
        x["q"][self._arm], x["arm_start_distance"][()] = arms[entry], distance[entry]

    def _choose_stage(
        self, stage: Stage, x: dict[str, float], y: dict[str, Array], results: dict[str, float]
    ) -> Status:
        """Choose the next stage as iteration.c does, see there.

        Args:
            stage: Stage of this iteration.
            x: Scalar fields of the state before the iteration.
            y: State after the iteration; changed.
            results: Results of the stage.
        """
        step, p = self._step, self._p
        candidates, nearest = step.layouts.candidates, p["nearest"][()] > 0
        is_settled, is_within = (results[name] > 0 for name in ("is_settled", "is_within"))
        is_later_restart = x["candidates_before"] > 0
        cost = float(y["cost"][()])

        def assign(**values: float) -> None:
            for name, value in values.items():
                y[name][...] = value

        def goes_to(next_stage: Stage, status: Status = Status.RUNNING) -> Status:
            assign(phase=next_stage)
            return status

        def to_next_candidate() -> Status:
            assign(candidate=x["candidate"] + 1)
            return goes_to(Stage.CANDIDATE)

        def with_arm(is_solved: bool) -> Status:
            low, high = p["lower"][self._arm], p["upper"][self._arm]
            y["q"][self._arm] = np.clip(y["arm_best"], low, high)
            return goes_to(Stage.REFINEMENT, Status.SOLVED if is_solved else Status.RUNNING)

        def arm_stage() -> Stage:
            is_complete = Stage.ARM_STEPS not in step.stages
            uses_steps = is_later_restart or (step.uses_steps_near_q0 and nearest)
            is_closed_form = is_complete or (step.arm is not None and not uses_steps)
            return Stage.ARM_PLACEMENT if is_closed_form else Stage.ARM_STEPS

        def is_new_minimum(name: str) -> bool:
            if results["rms_ratio"] > TOLERANT_FIT.near_miss_ratio:
                return False
            if abs(cost - x[name]) <= MINIMAX.same_cost_tolerance * x[name]:
                assign(repeated_minima=x["repeated_minima"] + 1)
                return False
            assign(**{name: cost})
            return results["rms_ratio"] <= TOLERANT_FIT.max_start_ratio

        def update_smallest(name: str, value: float) -> None:
            is_repeated = value > MINIMAX.improvement_ratio * x[name]
            assign(repeated_minima=x["repeated_minima"] + is_repeated)
            assign(**{name: min(value, x[name])})

        def after_hand() -> Status:
            if not is_within and x["candidate"] + 1 < candidates:
                return to_next_candidate()
            status = Status.SOLVED if is_within else Status.STALLED
            chooses = step.choices is not None and nearest
            next_stage = Stage.ARM_CHOICE if chooses else arm_stage()
            return goes_to(next_stage, status if p["hand_only"][()] > 0 else Status.RUNNING)

        match stage:
            case Stage.START:
                assign(best_cost=min(results["cost"], x["best_cost"]))
                if is_within:
                    return Status.SOLVED
                if self._arm and results["cost"] > STAGE_PARAMETERS.max_cost_of_q0:
                    return to_next_candidate()
                return goes_to(Stage.REFINEMENT)
            case Stage.CANDIDATE:
                if x["candidate"] < candidates:
                    is_tolerant = is_later_restart and int(x["candidate"]) % 2
                    hand_stage = Stage.TOLERANT_REFINEMENT if is_tolerant else Stage.REFINEMENT
                    return goes_to(Stage.HAND_FIT if self._arm else hand_stage)
                y["q"][:] = y["best_q"]
                return Status.STALLED
            case Stage.HAND_FIT:
                is_first = x["candidate"] + x["candidates_before"] <= 0
                is_first = is_first and x["stage_iterations"] < 1
                is_far = results["cost"] > STAGE_PARAMETERS.max_cost_of_q0_hand
                if candidates > 1 and nearest and is_first and is_far:
                    return to_next_candidate()
                if not is_settled:
                    return goes_to(Stage.HAND_FIT)
                if not is_within and is_new_minimum("hand_fit_minimum"):
                    assign(**initial_lm_state())
                    return goes_to(Stage.TOLERANT_HAND_FIT)
                return after_hand()
            case Stage.TOLERANT_HAND_FIT:
                if not is_settled:
                    return goes_to(stage)
                if is_within:
                    assign(hand_fit_minimum=0)
                else:
                    update_smallest("hand_fit_min_excess", cost)
                return after_hand()
            case Stage.ARM_PLACEMENT:
                is_allowed = results["arm_is_allowed"] > 0
                if not is_allowed and y["stage_iterations"][()] < step.trials[is_later_restart]:
                    return goes_to(Stage.ARM_PLACEMENT)
                assign(stage_iterations=0)
                return with_arm(
                    is_allowed and results["arm_is_exact"] > 0 and x["meets_contacts"] > 0
                )
            case Stage.ARM_CHOICE:
                is_allowed = results["arm_is_allowed"] > 0
                if y["stage_iterations"][()] < step.trials[2 if is_allowed else 3]:
                    return goes_to(Stage.ARM_CHOICE)
                assign(stage_iterations=0)
                if not is_allowed:
                    assign(arm_margin=ARM_SEARCH.no_margin)
                    return goes_to(arm_stage())
                return with_arm(
                    step.arm is not None and step.arm.is_exact and x["meets_contacts"] > 0
                )
            case Stage.ARM_STEPS:
                is_exact = results["cost"] < FIT.exact * FIT.exact
                flipped = int(results["joint_to_flip"]) if is_settled and is_later_restart else 0
                if flipped:
                    k = self._arm[flipped - 1]
                    y["q"][k] = p["lower"][k] + p["upper"][k] - y["q"][k]
                assign(
                    arm_flipped_joint=flipped if is_settled else x["arm_flipped_joint"],
                    arm_starts=x["arm_starts"] + (is_settled and not flipped),
                )
                is_close = is_settled and results["arm_is_close"] > 0 and not is_later_restart
                has_starts = y["arm_starts"][()] < NUMERIC_ARM_PARAMETERS.starts
                if has_starts and not (is_exact or is_close):
                    return goes_to(Stage.ARM_STEPS)
                assign(arm_flipped_joint=0)
                return with_arm(is_exact and x["meets_contacts"] > 0)
            case Stage.REFINEMENT:
                if cost < x["best_cost"]:
                    assign(best_cost=cost)
                    y["best_q"][:] = y["q"]
                if not is_settled:
                    return goes_to(Stage.REFINEMENT)
                if is_within:
                    return Status.SOLVED
                if not is_new_minimum("refinement_minimum"):
                    return to_next_candidate()
                assign(**initial_lm_state())
                return goes_to(Stage.TOLERANT_REFINEMENT)
            case Stage.TOLERANT_REFINEMENT:
                if not is_settled:
                    return goes_to(stage)
                if is_within:
                    return Status.SOLVED
                assign(**initial_lm_state())
                return goes_to(Stage.BALANCE)
            case Stage.BALANCE:
                if is_within:
                    return Status.SOLVED
                if not is_settled:
                    return goes_to(Stage.BALANCE)
                assign(**initial_lm_state(), power=0)
                update_smallest("balance_min_ratio", results["max_ratio"])
                return to_next_candidate()
        raise AssertionError(stage)
