"""Numbers of the hand-first method, each with what it was chosen by."""

from __future__ import annotations

from dataclasses import dataclass, fields

from casadi_ik.errors import InputError
from casadi_ik.model.description import RobotDescription


@dataclass(frozen=True)
class HandFirstParameters:
    """Parameters of the method.

    A round begins from up to `candidates` hand postures. In order there are `rounds` from tables,
    `global_rounds` from anywhere that every target gets, and `rugged_rounds` more for targets that
    end elsewhere each time. Many motors are more than `many_motors` of the hand: such a hand has so
    many places where fits end that few of them tell little. Where held motors leave a hand or arm
    less than its motions, no table holds its postures, and the numbers for many motors count.

    Attributes:
        table: Hand postures the targets' shapes are compared with.
        candidates: Of those, how many a round of the compiled loop may start from.
        wide_table: The same for the rounds after the first.
        rounds: Rounds that begin from the tables, each from the next best candidates.
        max_rounds: Rounds of all kinds at most, each of up to `candidates` hand postures: the limit
            of effort. 1 solves nearly all that can be reached. None: as many as may help.
        few_motors_table: Part of `table` that a hand with few motors and more than three fingers
            is compared with: its contacts' shape is more telling, and each row costs as much as
            three of three fingers. Of 4,000 targets of a Panda with a hand of five fingers and six
            motors 16 instead of 4 need a second posture, and all of them an eighth less time.
        many_motors: See above.
        at_limits: Part of the range that the wide table moves to the limits.
        sure_rounds: Rounds from tables in any case.
        finger_rows: Postures of a finger that is chosen by itself; with four times as many no more
            fits succeed.
        finger_turns: How often palm and fingers are chosen in turns; a third time mends little.
        pool: Postures mended finger by finger for a round after the first: not those that look like
            the target, but as many others in every round. With 64 a batch of an Allegro, LEAP or
            Shadow hand takes up to a third longer.
        late_round: From this round on every second one begins from postures that are not mended. Of
            64,000 targets of a LEAP hand near limits 140 are left after 16 rounds and 16 after 64
            where all are, 100 and 8 by turns.
        global_rounds: See above.
        rugged_rounds: Of a hand with few motors, and with many. Of 640,000 targets at limits of
            LEAP hands on eight arms 200 are left after 32 rounds of all kinds, 55 after 64, 14
            after 100, 6 after 150 and 2 after the last.
        same_minimum: When so many fits and balances have ended where one had before, no table holds
            another kind; of a hand with few motors, and with many. With eight a reachable target
            was given up one round too early; sixteen cost a tenth more time where contacts
            contradict each other. A hand with many motors comes back to a minimum that just misses
            from many sides: one target did 166 times ten rounds before it was solved.
        flat_cost: Cost (0.01 mm, 0.1 mrad) above which this is a minimum, no long flat valley.
        nearly_fits: Cost (0.3 mm, 3 mrad) below which every second round from anywhere goes on from
            the best so far, and the others take hands on the line through the last two that were
            the best. Three parallel fingers meet their contacts all along such a line, but for
            some um, and the arm can hold but one end of it: of 8,800 targets about 44 of a KUKA LWR
            with a Barrett hand that the climbing search had missed at 1e-6, 1,284 are missed
            without such lines, 368 with them.
        along_line: How far along the line such hands are at most [of the range of the motor that
            moves most].
        far_cost: Cost (14 mm, 8 deg; 0.3 m) from which on a target that still misses is taken to be
            out of reach; of a hand with few motors, and with many.
        far_cost_shrinks: After the k-th rugged round at most this / (k + 1): the longer a target
            stays far off the less there is to hope. One had more than 3 after 7 rounds and was
            solved in the 18th, one 0.3 after 26 and was solved in the 75th.
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
        """Whether a robot's hand has many motors."""
        return len(robot.hand_actuators) > self.many_motors

    @property
    def first_rugged(self) -> int:
        """Rounds before those from anywhere that not every target gets."""
        return self.rounds + self.global_rounds

    def all_rounds(self, robot: RobotDescription) -> int:
        """Rounds of all kinds at most."""
        every = self.first_rugged + self.rugged_rounds[self.is_many(robot)]
        every = min(every, BODY.rounds) if robot.sides else every
        return min(every, self.max_rounds or every)


@dataclass(frozen=True)
class StageParameters:
    """When one stage of a solve follows another.

    Attributes:
        before_the_arm: Part of the tolerances that a hand is fitted to: the arm that follows it
            adds its rounding, which at 1e-6 has made an answer of 1.0000006e-6.
        fit_part: Part of them that a hand of a body or of a later round is fitted to, where it can
            be: a hand that fits by half has its palm where the arm need not reach. Of 20,000
            targets around one that a climbing search had missed at 5 mm, 2,762 are missed where
            all hands fit by half, 2,131 with a tenth, 73 with a hundredth, 49 with a thousandth.
        own_hand: Cost, with the best palm, up to which the hand as it is is fitted before others.
        whole: Cost up to which a start is refined as a whole (three contacts off by 4 cm each).
    """

    before_the_arm: float = 0.999
    fit_part: float = 0.01
    own_hand: float = 0.5
    whole: float = 0.5


STAGES = StageParameters()


@dataclass(frozen=True)
class BodyParameters:
    """How trunks are tried for the palms of a body.

    Attributes:
        rounds: Rounds of all kinds at most. Of 500,000 targets of two Pandas with Allegros near
            limits 18 are missed at 1e-6 with 16, 3 with these, in the same time.
        first_trunks: Trunks tried for the palms of the first hand postures of the first round.
        later_trunks: The same of later rounds. Near limits few trunks lead to all palms: of 100,000
            targets of a G1 at 1e-6 with half of the motors within 1 % of an end 18 are missed
            with 48 in all rounds, 2 to 4 with these.
        other_trunks: For palms of hand postures that are not the first.
        least_trunks: Trunks tried in any case for palms of hands that fit: of 40,000 of an H1-2 one
            that is solved is still 8 cm off after 60, none more than 3 after 120.
        far_trunks: Trunks times the least cost they came to (1: 10 cm or 1 rad) from which on a
            target is out of reach. Of 200,000 targets of an H1-2 at 1e-6 near limits those that
            are solved last have 59, 42 and 37, all but eight less than 15; at 5 mm 150 lost one of
            200,000, 400 none.
        loose_trunks: The same where contacts leave palms a freedom. Without, two Pandas with
            Allegros look for a second for what is 2 m away.
        one_arm_trunks: The same of one arm on a trunk. Of 1,000,000 targets of an LWR on a mobile
            base near limits 20 were lost with 400 at 5 mm, some even with 5,000.
        at_limits: Part of a motor's range that every second trunk moves to its limits.
        patience: Steps of trunk and arms with little gain before they are given up; with 3 instead
            of 8 three times as many of these targets are missed.
        budget: Steps of trunk and arms in all, ten times as many where little is left.
        nearly: Cost (3 cm and 18 deg) below which arms are placed anew at the trunk found.
        again_trials: Looks at their redundancies then.
        around: The look that begins around one value of the redundancy, of every second trunk.
        from_anywhere: Every so many trunks the arms begin from anywhere instead.
        later_anywhere: The same of later rounds: what closed forms do not lead to at 60 trunks they
            hardly ever lead to.
        closer_every: Every so many trunks one between an even spread and the best one so far.
        trunk_unit: What counts as a unit of the trunk where what is near is wanted; of arms 1.
        box: After so many trunks half as far from the best one.
        missed: Margin below zero of an arm that is within its limits, but not where it should be.
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
