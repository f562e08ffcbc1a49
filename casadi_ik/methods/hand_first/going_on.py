"""What a round leaves to the next one, and when another one may help."""

from __future__ import annotations

CARRIED = (
    *("passed", "near", "balanced", "least", "returns"),
    *("best_cost", "best_q", "counts"),
)
"""What a round leaves to the next: how far the numeric arm's list of starts is through, which fits
were balanced in vain, and what was found."""

RETURNS = 8
"""When so many fits and balances have ended where one had before, no table holds another kind."""

SURE = 1e-8
"""Cost (0.01 mm, 0.1 mrad) above which this is a minimum, and not a long flat valley."""

NEAR = 0.02
"""Cost (14 mm, 8 deg) from which on a target that still misses is taken to be out of reach."""

VARIED = 2
"""Rounds of tables in any case: the second takes hands that differ from each other."""

TINY = 1e-9
"""Smallest range [rad or m] a motion is measured by."""
