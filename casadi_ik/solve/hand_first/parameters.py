"""Parameters of the hand-first method, with the evidence for their values."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from casadi_ik.errors import InputError
from casadi_ik.model.description import RobotDescription


@dataclass(frozen=True)
class HandFirstParameters:
    """Parameters of the search.

    A restart (round) tries up to `candidates` hand postures. There are `rounds` restarts from
    tables, then `global_rounds` from low-discrepancy postures for every target, then up to
    `rugged_rounds` for targets whose fits keep converging to new minima. A hand with more than
    `many_motors` motors has many local minima, so that a few of them say little. Pairs of values
    are for hands with few and with many motors. If fixed motors leave a hand or arm with fewer
    motions, no table contains its postures, and the values for many motors apply.

    Attributes:
        table: Number of hand postures in the table of the first restart.
        candidates: Maximum number of hand postures of a restart.
        wide_table: Number of hand postures in the table of later restarts.
        rounds: Number of restarts from the tables, each from the next best candidates.
        max_rounds: Maximum number of restarts of all kinds, the limit of effort. With 1 nearly all
            reachable targets are solved. None: as many as are worthwhile.
        few_motors_table: Fraction of `table` for hands with few motors and more than three fingers:
            the shape of their contacts is more distinctive, and a row costs three times as much as
            with three fingers. Source: 4,000 targets of a Panda with a hand of five fingers and six
            motors; 16 instead of 4 need a second posture, and all are an eighth faster.
        many_motors: Largest number of motors of a hand with few motors.
        at_limits: Fraction of the range that the wide table maps to the limits.
        sure_rounds: Minimum number of restarts from tables.
        finger_rows: Number of postures of a single finger for repairs. Source: four times as many
            give no more successful fits.
        finger_turns: Number of alternations between palm pose and fingers in a repair; a third one
            improves little.
        pool: Number of low-discrepancy postures that are repaired for a restart. Source: with 64 a
            batch of an Allegro, LEAP or Shadow hand is slower by up to a third.
        late_round: Number of the restart from which every second one uses postures without repair.
            Source: of 64,000 targets of a LEAP hand near limits 140 are unsolved after 16 restarts
            and 16 after 64 if all are repaired, 100 and 8 if they alternate.
        global_rounds: Number of global restarts for every target.
        rugged_rounds: Maximum number of extra global restarts. Source: of 640,000 targets at limits
            of LEAP hands on eight arms 200 are unsolved after 32 restarts of all kinds, 55 after
            64, 14 after 100, 6 after 150 and 2 after the last.
        same_minimum: Number of fits that converged to a previous minimum after which the tables
            offer no other kind. Source: with eight a reachable target was given up one restart too
            early; sixteen take a tenth more time where contacts contradict each other. A hand with
            many motors reaches a minimum that barely misses from many sides: one target did so 166
            times ten restarts before it was solved.
        flat_cost: Cost (0.01 mm, 0.1 mrad) above which the end of a fit is a minimum, not a point
            in a flat valley.
        nearly_fits: Cost (0.3 mm, 3 mrad) below which every second global restart starts from the
            incumbent, and the others use hands on the line through the last two incumbents. Three
            parallel fingers meet their contacts within micrometres along such a line; the
            arm can reach one end only. Source: of 8,800 targets around 44 of a KUKA LWR with a
            Barrett hand that the search had missed at 1e-6, 1,284 are missed without such lines,
            368 with them.
        along_line: Largest distance of such hands along the line [range of the motor that moves
            most].
        far_cost: Cost (14 mm, 8 deg; 0.3 m) above which a target that is still missed counts as out
            of reach.
        wide_angle: Angle tolerance [rad] above which configurations within tolerance are often far
            from the minima of exact fits, so that repeated minima do not end the search.
        wide_rounds: Number of extra global restarts for such tolerances. Source: of 4,000 targets
            of a Puma 560 within 1 mm and 60 deg of a configuration 16 are missed if repeated minima
            end the search, 1 with 20 extra restarts.
        far_cost_shrinks: The cost limit after extra restart k is at most this / (k + 1), because
            success becomes less likely the longer a target stays far off. Source: one target had a
            cost above 3 after 7 restarts and was solved in the 18th, another one 0.3 after 26 and
            was solved in the 75th.
    """

    table: int = 1024
    candidates: int = 8
    wide_table: int = 8192
    rounds: int = 6
    max_rounds: int | None = None
    few_motors_table: float = 3 / 8
    many_motors: int = 9
    at_limits: float = 0.5
    sure_rounds: int = 2
    finger_rows: int = 128
    finger_turns: int = 2
    pool: int = 24
    late_round: int = 12
    global_rounds: int = 5
    rugged_rounds: tuple[int, int] = (40, 250)
    same_minimum: tuple[int, int] = (16, 600)
    flat_cost: float = 1e-8
    nearly_fits: float = 1e-5
    along_line: float = 1.5
    far_cost: tuple[float, float] = (0.02, 10.0)
    wide_angle: float = math.radians(10)
    wide_rounds: int = 20
    far_cost_shrinks: float = 60.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if "int" not in str(field.type) or isinstance(value, tuple):
                continue
            if value is None and field.name == "max_rounds":
                continue
            if isinstance(value, bool) or not (isinstance(value, int) and value >= 1):
                raise InputError(f"{field.name}: found {value!r}, expected a whole number >= 1")
        min_rows = self.candidates * self.rounds
        for name in ("table", "wide_table"):
            if getattr(self, name) < min_rows:
                raise InputError(
                    f"{name}: found {getattr(self, name)}, expected at least candidates x rounds = "
                    f"{min_rows}"
                )

    def is_many(self, robot: RobotDescription) -> bool:
        """Return whether the hand of a robot has many motors."""
        return len(robot.hand_actuators) > self.many_motors

    @property
    def first_rugged(self) -> int:
        """Number of restarts before the extra ones."""
        return self.rounds + self.global_rounds

    def all_rounds(self, robot: RobotDescription) -> int:
        """Return the maximum number of restarts of all kinds."""
        count = self.first_rugged + self.rugged_rounds[self.is_many(robot)]
        count = min(count, TRUNK_PARAMETERS.max_restarts) if robot.sides else count
        return min(count, self.max_rounds or count)


@dataclass(frozen=True)
class StageParameters:
    """Criteria for the choice of the next stage.

    Attributes:
        fit_fraction: Fraction of the tolerances to which a hand is fitted; the rounding of the arm
            comes on top. Source: with 1 a solution at 1e-6 had an error of 1.0000006e-6.
        tight_fit_fraction: Fraction of the tolerances to which hands of later restarts and of
            multi-arm robots are fitted where possible: the palm of a hand that barely fits may be
            out of the arm's reach. Source: of 20,000 targets around one that the search had missed
            at 5 mm, 2,762 are missed with a half, 2,131 with a tenth, 73 with a hundredth, 49 with
            a thousandth.
        max_cost_of_q0_hand: Largest cost, with the best palm pose, at which the hand of q0 is
            fitted first.
        max_cost_of_q0: Largest cost at which q0 itself is refined (three contacts off by 40 mm
            each).
    """

    fit_fraction: float = 0.999
    tight_fit_fraction: float = 0.01
    max_cost_of_q0_hand: float = 0.5
    max_cost_of_q0: float = 0.5


STAGE_PARAMETERS = StageParameters()


@dataclass(frozen=True)
class TrunkParameters:
    """Parameters of the search for trunk and arms of a multi-arm robot.

    Attributes:
        max_restarts: Maximum number of restarts of all kinds. Source: of 500,000 targets of two
            Pandas with Allegro hands near limits 18 are missed at 1e-6 with 16, 3 with 64, in the
            same time.
        first_trunk_trials: Maximum number of trunk trials for the first hand postures of the first
            restart.
        later_trunk_trials: The same number in later restarts. Near limits few trunk positions reach
            all palm poses. Source: of 100,000 targets of a G1 at 1e-6 with half of the motors
            within 1 % of a limit 18 are missed with 48 in all restarts, 2 to 4 with these.
        other_trunk_trials: Maximum number of trunk trials for hand postures after the first.
        min_fitting_trials: Minimum number of trunk trials with hands that fit. Source: of 40,000
            targets of an H1-2 one that is solved is still 80 mm off after 60, none more than 30 mm
            after 120.
        max_weighted_trials: Largest product of the number of trunk trials and their smallest cost
            (1: 100 mm or 1 rad); above it a target counts as out of reach. Source: of 200,000
            targets of an H1-2 at 1e-6 near limits the three that are solved last have 59, 42 and
            37, all but eight less than 15; at 5 mm 150 lost one of 200,000, 400 none.
        max_weighted_trials_free_palms: The same limit where contacts leave palms free. Source:
            without it two Pandas with Allegro hands search for a second for targets 2 m away.
        max_weighted_trials_one_arm: The same limit for one arm on a trunk. Source: of 1,000,000
            targets of an LWR on a mobile base near limits 20 were lost with 400 at 5 mm, some even
            with 5,000.
        trunk_limit_fraction: Fraction of a motor's range that every second trunk trial maps to the
            limits.
        patience: Number of consecutive steps of trunk and arms with slow progress that ends them.
            Source: with 3 instead of 8 three times as many of these targets are missed.
        budget: Maximum number of steps of trunk and arms; ten times as many at small costs.
        replacement_cost: Cost (30 mm and 18 deg) below which arms are placed again at the trunk of
            the trial.
        replacement_trials: Number of arm trials of that placement.
        local_arm_trial: Number of the arm trial with which every second trunk trial begins, so that
            arms are sampled around one value of the redundancy only.
        free_arms_period: Period of the trunk trials whose arms start from low-discrepancy
            configurations instead of closed forms.
        later_free_arms_period: The same period in later restarts: targets that closed forms miss at
            60 trunk positions are hardly ever solved by them.
        local_trunk_period: Period of the trunk trials near the best trunk position so far.
        trunk_unit: Scale of trunk motions relative to arm motions if the preference is q0.
        radius_trials: Number of trials after which the sampling radius around the best trunk
            position has halved.
        miss_margin: Negative margin of an arm within its limits that misses its palm pose.
    """

    max_restarts: int = 64
    first_trunk_trials: int = 60
    later_trunk_trials: int = 800
    other_trunk_trials: int = 24
    min_fitting_trials: int = 120
    max_weighted_trials: float = 400.0
    max_weighted_trials_free_palms: float = 4000.0
    max_weighted_trials_one_arm: float = 40000.0
    trunk_limit_fraction: float = 0.5
    patience: int = 8
    budget: int = 25
    replacement_cost: float = 0.1
    replacement_trials: int = 4
    local_arm_trial: int = 5
    free_arms_period: int = 8
    later_free_arms_period: int = 2
    local_trunk_period: int = 4
    trunk_unit: float = 0.25
    radius_trials: float = 8.0
    miss_margin: float = 1e-12


TRUNK_PARAMETERS = TrunkParameters()
