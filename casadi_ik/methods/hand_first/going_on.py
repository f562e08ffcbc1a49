"""What a round leaves to the next one, and when another one may help."""

from __future__ import annotations

COUNTED = ("counts",)
"""What a search leaves to the next one, which else begins anew."""

CARRIED = (
    *("passed", "near", "balanced", "least", "returns"),
    *("best_cost", "best_q", *COUNTED),
)
"""What a round leaves to the next: how far the numeric arm's list of starts is through, which fits
were balanced in vain, and what was found."""

MANY = 9
"""Hands of more motors have so many places where fits end that few of them tell little."""

RETURNS, RETURNS_OF_MANY = 16, 600
"""When so many fits and balances have ended where one had before, no table holds another kind. With
eight a reachable target was given up one round too early; sixteen cost a tenth more time where the
contacts contradict each other. A hand with more than `MANY` motors comes back to a minimum that
just misses from many sides before it finds the way past it: one target had come back 166 times ten
rounds before it was solved. Likewise a hand of whose motors some are held, since no table holds its
postures, or one whose arm is left with less than a palm's six motions."""

SURE = 1e-8
"""Cost (0.01 mm, 0.1 mrad) above which this is a minimum, and not a long flat valley."""

RUGGED, RUGGED_OF_MANY = 40, 250
"""Rounds from anywhere for a target whose fits end somewhere else each time, besides those that
every target gets. Of 640,000 targets at limits of LEAP hands on eight arms 200 are left after 32
rounds of all kinds, 55 after 64, 14 after 100, 6 after 150 and 2 after the last."""

NEAR, NEAR_OF_MANY, NEAR_SHRINKS = 0.02, 10.0, 60.0
"""Cost (14 mm, 8 deg) from which on a target that still misses is taken to be out of reach; of a
hand with more than `MANY` motors, or of held ones, another one (0.3 m), and after the k-th of
the `RUGGED` rounds at most `NEAR_SHRINKS` / (k + 1), since the longer a target stays far off the
less there is to hope. Some that can be reached stay there long: one had more than 3 after 7 rounds
and was solved in the 18th, one 0.3 after 26 and was solved in the 75th."""

VARIED = 2
"""Rounds of tables in any case: the second takes hands that differ from each other."""

TINY = 1e-9
"""Smallest range [rad or m] a motion is measured by."""


def goes_on(number: int) -> bool:
    """Whether a round from anywhere, from 0, begins at the best so far if that lies in a valley.

    The floor of some valleys falls so little that a refinement gives up: ten of them have reached
    the end. And the best so far may be another than when hands along its valley were tried. Every
    other round, since what has come to a valley's lowest place has to leave it.
    """
    return number % 2 == 0


def rugged(motors: int) -> int:
    """`RUGGED` of a hand of so many motors."""
    return RUGGED_OF_MANY if motors > MANY else RUGGED


def most_returns(motors: int) -> int:
    """`RETURNS` of a hand of so many motors."""
    return RETURNS_OF_MANY if motors > MANY else RETURNS


def near_cost(motors: int) -> float:
    """`NEAR` of a hand of so many motors."""
    return NEAR_OF_MANY if motors > MANY else NEAR
