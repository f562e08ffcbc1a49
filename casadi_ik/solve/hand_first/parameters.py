"""Parameters of the hand-first method, with the evidence for their values."""

from __future__ import annotations

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
            with three fingers. Source: of 4,000 targets of a Panda with a hand of five fingers and
            six motors 16 instead of 4 need a second posture, and all take an eighth less time.
        many_motors: Largest number of motors of a hand with few motors.
        at_limits: Fraction of the range that the wide table maps to the limits.
        sure_rounds: Minimum number of restarts from tables.
        finger_rows: Number of postures of a single finger for repairs. Source: four times as many
            give no more successful fits.
        finger_turns: Number of alternations between palm pose and fingers in a repair; a third one
            improves little.
        pool: Number of low-discrepancy postures that are repaired for a restart. Source: with 64 a
            batch of an Allegro, LEAP or Shadow hand takes up to a third longer.
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
            parallel fingers meet their contacts within micrometres along such a line, of which the
            arm can reach one end only. Source: of 8,800 targets around 44 of a KUKA LWR with a
            Barrett hand that the search had missed at 1e-6, 1,284 are missed without such lines,
            368 with them.
        along_line: Largest distance of such hands along the line [range of the motor that moves
            most].
        far_cost: Cost (14 mm, 8 deg; 0.3 m) above which a target that is still missed counts as out
            of reach.
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
        least = self.candidates * self.rounds
        for name in ("table", "wide_table"):
            if getattr(self, name) < least:
                raise InputError(
                    f"{name}: found {getattr(self, name)}, expected at least candidates x rounds = "
                    f"{least}"
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
        every = self.first_rugged + self.rugged_rounds[self.is_many(robot)]
        every = min(every, BODY.rounds) if robot.sides else every
        return min(every, self.max_rounds or every)


@dataclass(frozen=True)
class StageParameters:
    """Criteria by which one stage of a solve follows another.

    Attributes:
        before_the_arm: Fraction of the tolerances to which a hand is fitted; the arm that follows
            adds its rounding. Source: at 1e-6 it made an answer of 1.0000006e-6.
        fit_part: Fraction of the tolerances to which hands of later restarts and of multi-arm
            robots are fitted where possible: a hand that fits barely may have its palm out of the
            arm's reach. Source: of 20,000 targets around one that the search had missed at 5 mm,
            2,762 are missed with a half, 2,131 with a tenth, 73 with a hundredth, 49 with a
            thousandth.
        own_hand: Largest cost, with the best palm pose, at which the hand of q0 is fitted first.
        whole: Largest cost at which q0 itself is refined (three contacts off by 40 mm each).
    """

    before_the_arm: float = 0.999
    fit_part: float = 0.01
    own_hand: float = 0.5
    whole: float = 0.5


STAGES = StageParameters()


@dataclass(frozen=True)
class BodyParameters:
    """Parameters of the search for the trunk of a multi-arm robot.

    Attributes:
        rounds: Maximum number of restarts of all kinds. Source: of 500,000 targets of two Pandas
            with Allegro hands near limits 18 are missed at 1e-6 with 16, 3 with 64, in the same
            time.
        first_trunks: Number of trunk trials for the first hand postures of the first restart.
        later_trunks: Number of trunk trials in later restarts. Near limits few trunks reach all
            palms. Source: of 100,000 targets of a G1 at 1e-6 with half of the motors within 1 % of
            a limit 18 are missed with 48 in all restarts, 2 to 4 with these.
        other_trunks: Number of trunk trials for hand postures after the first.
        least_trunks: Minimum number of trunk trials for hands that fit. Source: of 40,000 targets
            of an H1-2 one that is solved is still 80 mm off after 60, none more than 30 mm after
            120.
        far_trunks: Largest product of trunk trials and their smallest cost (1: 100 mm or 1 rad);
            above it a target counts as out of reach. Source: of 200,000 targets of an H1-2 at 1e-6
            near limits the three that are solved last have 59, 42 and 37, all but eight less than
            15; at 5 mm 150 lost one of 200,000, 400 none.
        loose_trunks: The same limit where contacts leave palms free. Source: without it two Pandas
            with Allegro hands search for a second for targets 2 m away.
        one_arm_trunks: The same limit for one arm on a trunk. Source: of 1,000,000 targets of an
            LWR on a mobile base near limits 20 were lost with 400 at 5 mm, some even with 5,000.
        at_limits: Fraction of a motor's range that every second trunk maps to its limits.
        patience: Number of consecutive steps of trunk and arms with slow progress that ends them.
            Source: with 3 instead of 8 three times as many of these targets are missed.
        budget: Maximum number of steps of trunk and arms; ten times as many at small costs.
        nearly: Cost (30 mm and 18 deg) below which arms are placed again at the best trunk.
        again_trials: Number of redundancy samples of that placement.
        around: Index of the redundancy sample from which every second trunk samples locally.
        from_anywhere: Period of trunk trials whose arms start from low-discrepancy configurations.
        later_anywhere: The same period in later restarts: targets that closed forms miss at 60
            trunks are hardly ever found by them.
        closer_every: Period of trunk trials near the best trunk so far.
        trunk_unit: Scale of trunk motions relative to arm motions if the preference is q0.
        box: Number of trials after which the sampling radius around the best trunk has halved.
        missed: Negative margin of an arm within its limits that misses its palm pose.
    """

    rounds: int = 64
    first_trunks: int = 60
    later_trunks: int = 800
    other_trunks: int = 24
    least_trunks: int = 120
    far_trunks: float = 400.0
    loose_trunks: float = 4000.0
    one_arm_trunks: float = 40000.0
    at_limits: float = 0.5
    patience: int = 8
    budget: int = 25
    nearly: float = 0.1
    again_trials: int = 4
    around: int = 5
    from_anywhere: int = 8
    later_anywhere: int = 2
    closer_every: int = 4
    trunk_unit: float = 0.25
    box: float = 8.0
    missed: float = 1e-12


BODY = BodyParameters()
