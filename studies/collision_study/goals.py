"""What the choice of free answers was to reach, beside what it reached, from the same figures."""

from __future__ import annotations

from typing import Any

import numpy as np

COMPLETE = 99.9
"""Part [%] of the targets with an answer of 2 mm to spare that shall get a free one."""

MEANS = {0: 100.0, 8: 300.0}
"""Mean time of a target [us] by clutter."""

HEADS = ["goal", "wanted", "found", "reached", "if not, why"]


def rows(robot: str, clutter: int, targets: list[dict[str, Any]]) -> list[list[str]]:
    """Rows of the table of goals for one robot and clutter: goal, wanted, found, reached, why."""
    answered = [one for one in targets if one["status"] == "SOLVED"]
    missed = sum(one["missed"] for one in targets)
    asked = len(answered) + missed
    part = 100 * len(answered) / max(asked, 1)
    false = sum(one["false"] for one in targets)
    table = [
        _row(
            f"{robot}, clutter {clutter}: has an answer, gets one",
            f">= {COMPLETE} %",
            f"{part:.2f} % of {asked}",
            part >= COMPLETE,
            _causes(targets),
        ),
        _row(
            f"{robot}, clutter {clutter}: called free, not so by coal",
            "0",
            str(false),
            not false,
            "",
        ),
    ]
    if clutter in MEANS:
        every = 1e6 * float(np.mean([one["batch"] for one in targets]))
        blind = 1e6 * float(np.mean([one["blind_time"] for one in targets]))
        own = [1e6 * one["answered_time"] for one in answered]
        mine = float(np.mean(own)) if own else np.nan
        blocked = 100 * (1 - len(answered) / len(targets))
        touching = 100 * (1 - float(np.mean([one["blind"] for one in targets])))
        first = (
            f"contacts alone take {blind:.0f} us, and {touching:.0f} % of their answers touch "
            "something and are exchanged"
        )
        why = first + (
            f"; {blocked:.0f} % of the targets have no answer that is found: they take all that is "
            "looked at before a target is given up, and the reasons"
            if blocked
            else ""
        )
        table.append(
            _row(
                f"{robot}, clutter {clutter}: mean of all targets",
                f"<= {MEANS[clutter]:.0f} us",
                f"{every:.0f} us",
                every <= MEANS[clutter],
                why,
            )
        )
        table.append(
            _row(
                f"{robot}, clutter {clutter}: mean of those that have an answer",
                f"<= {MEANS[clutter]:.0f} us",
                f"{mine:.0f} us",
                mine <= MEANS[clutter],
                first,
            )
        )
    return table


def _row(goal: str, wanted: str, found: str, reached: bool, why: str) -> list[str]:
    return [goal, wanted, found, "yes" if reached else "**no**", "" if reached else why]


def _causes(targets: list[dict[str, Any]]) -> str:
    """What the missed targets have in common, by what was in the way."""
    pairs = [one["pair"] for one in targets if one["missed"]]
    return "missed, with what was in the way: " + "; ".join(sorted(set(pairs)))
