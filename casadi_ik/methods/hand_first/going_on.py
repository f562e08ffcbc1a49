"""What a round leaves to the next one, and when another one may help."""

from __future__ import annotations

CARRIED = (
    *("passed", "near", "balanced", "least", "returns"),
    *("best_cost", "best_q", "counts"),
)
"""What a round leaves to the next: how far the numeric arm's list of starts is through, which fits
were balanced in vain, and what was found."""

RETURNS, RETURNS_OF_MANY = 16, 160
"""When so many fits and balances have ended where one had before, no table holds another kind. With
eight a reachable target was given up one round too early; sixteen cost a tenth more time where the
contacts contradict each other. A hand with more than `MANY` motors comes back to a minimum that
just misses from many sides before it finds the way past it: of 2,400 targets near limits of a Panda
with a LEAP hand three were missed with 16, two with 64, none with 160, and those that just cannot
be reached take five times as long."""

SURE = 1e-8
"""Cost (0.01 mm, 0.1 mrad) above which this is a minimum, and not a long flat valley."""

NEAR, NEAR_OF_MANY, MANY = 0.02, (0.5, 0.06), 9
"""Cost (14 mm, 8 deg) from which on a target that still misses is taken to be out of reach; of a
hand with more than `MANY` motors others (70 mm, 40 deg; later 25 mm, 14 deg): its fits end in so
many places that how far off the best of them is tells little, and four in five of the targets that
were given up are solved for the time that it takes."""

EARLY = 4
"""Rounds in which the first of `NEAR_OF_MANY` counts: of 4000 targets that can be reached those
left by then had a tenth of it, of those that cannot seven in ten have more than `NEAR`."""

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


def most_returns(motors: int) -> int:
    """`RETURNS` of a hand of so many motors."""
    return RETURNS_OF_MANY if motors > MANY else RETURNS


def near_cost(motors: int, late: bool) -> float:
    """The cost from which on a target is taken to be out of reach of a hand of so many motors.

    Args:
        motors: Of the hand.
        late: Whether `EARLY` rounds have gone by in which it is asked for.
    """
    return NEAR_OF_MANY[late] if motors > MANY else NEAR
