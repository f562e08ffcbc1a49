"""What the study of every arm with every hand is to show, and which targets were missed."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from catalogue_pair import KINDS, TOLERANCES, Pair
from runner import markdown_table

HEADS = ["goal", "wanted", "found", "reached", "if not, why"]

SMALL_HAND, FIRST_USE = 9, 20.0
"""Motors of a small hand; seconds until a robot's first answers."""

RATIOS = {"small": 1.5, "large": 3.5}
"""Times of a target to the reference's, random hands."""

AGAIN = 5.0
"""Targets of a large hand that may need more than the first posture [%]."""

TAIL, WORST = 15.0, 5000.0
"""99 % of the targets within so many means; the slowest single one [us]."""

SHOWN = 5
"""Misses whose configurations are in the report; all of them are in a file beside it."""

Entries = Mapping[Pair, Mapping[str, Any]]

SEARCHED = (
    "arms that are not quite of their closed form take steps after it; hands of many motors need "
    "several fits, LEAP's most; arms of few joints reach few of the palms that fit"
)
LATER = "a round after the first takes 0.1 to 0.5 ms, and one target in a hundred needs one"
LATE = (
    "targets near limits may take a hundred rounds with hands of 16 motors; arms that are not "
    "quite of their form are searched by steps in later rounds"
)
CORNERED = "an arm with most joints at limits has few places to stand in, and narrow ones"


@dataclass(frozen=True)
class Goal:
    """A number that every pair should keep to.

    Attributes:
        name: What is asked.
        most: The largest that is good.
        unit: Of it.
        measure: Its value of a pair, None where it does not apply.
        why: What stands in the way.
    """

    name: str
    most: float
    unit: str
    measure: Callable[[Mapping[str, Any]], float | None]
    why: str


def _usual(tolerance: str) -> str:
    return f"all fingers/{KINDS[0]}/{tolerance}"


def _ratio(small: bool, tolerance: str) -> Callable[[Mapping[str, Any]], float | None]:
    def measure(entry: Mapping[str, Any]) -> float | None:
        if (entry["motors"] <= SMALL_HAND) != small:
            return None
        return entry["cells"][_usual(tolerance)]["ratio"]

    return measure


def _again(tolerance: str) -> Callable[[Mapping[str, Any]], float | None]:
    def measure(entry: Mapping[str, Any]) -> float | None:
        cell = entry["cells"][_usual(tolerance)]
        few = entry["motors"] <= SMALL_HAND
        return None if few else 100 * cell["restarted"] / cell["count"]

    return measure


def _tail(entry: Mapping[str, Any]) -> float:
    return max(
        entry["cells"][_usual(name)]["p99"] / entry["cells"][_usual(name)]["mean"]
        for name in TOLERANCES
    )


def goals() -> list[Goal]:
    """All but that of no misses."""
    ratios = [
        Goal(
            f"ratio of the mean, hands of {'up to' if small else 'more than'} {SMALL_HAND} motors, "
            f"{tolerance}",
            RATIOS["small" if small else "large"],
            "",
            _ratio(small, tolerance),
            SEARCHED,
        )
        for small in (True, False)
        for tolerance in TOLERANCES
    ]
    slowest = Goal(
        "slowest target of any kind",
        WORST,
        "us",
        lambda entry: max(cell["max"] for cell in entry["cells"].values()),
        LATE,
    )
    again = [
        Goal(
            f"random hands that need a second posture, more than {SMALL_HAND} motors, {tolerance}",
            AGAIN,
            "%",
            _again(tolerance),
            "with four motors a finger LEAP's fits end at limits; Shadow's wrist is held elsewhere",
        )
        for tolerance in TOLERANCES
    ]
    return [
        *ratios,
        *again,
        Goal("99 % to the mean, random hands", TAIL, "", _tail, LATER),
        slowest,
        Goal(
            "first use",
            FIRST_USE,
            "s",
            lambda entry: entry["first use"],
            "most of it compiles the loop of many motors; processes side by side take longer",
        ),
    ]


def goal_rows(found: Entries) -> list[list[str]]:
    """Rows of the table of goals."""
    rows = []
    for tolerance in TOLERANCES:
        cells = [
            cell
            for entry in found.values()
            for name, cell in entry["cells"].items()
            if name.endswith(tolerance)
        ]
        lost = sum(len(cell["missed"]) for cell in cells)
        count = sum(cell["count"] for cell in cells)
        rows.append(_row(f"missed, {tolerance}", "0", f"{lost} of {count:,}", not lost, CORNERED))
    for goal in goals():
        values = {pair.robot: goal.measure(entry) for pair, entry in found.items()}
        known = {name: value for name, value in values.items() if value is not None}
        if not known:
            continue
        kept = sum(value <= goal.most for value in known.values())
        worst = max(known, key=lambda name: known[name])
        unit = f" {goal.unit}" if goal.unit else ""
        text = f"{kept} of {len(known)} pairs; most {known[worst]:,.3g}{unit} ({worst})"
        whole = kept == len(known)
        rows.append(_row(goal.name, f"<= {goal.most:g}{unit}", text, whole, goal.why))
    return rows


def _row(goal: str, wanted: str, found: str, reached: bool, why: str) -> list[str]:
    return [goal, wanted, found, "yes" if reached else "**no**", "" if reached else why]


def missed_parts(found: Entries, path: Path) -> list[str]:
    """How many were missed of every kind and the first of them; all go into a csv file."""
    lost = [
        (pair.robot, name, miss)
        for pair, entry in found.items()
        for name, cell in entry["cells"].items()
        for miss in cell["missed"]
    ]
    path.unlink(missing_ok=True)
    if not lost:
        return ["None."]
    rows = [
        [robot, name, str(miss["row"]), miss["status"], " ".join(f"{x:.9g}" for x in miss["q"])]
        for robot, name, miss in lost
    ]
    heads = ["robot", "targets", "row", "status", "q"]
    with path.open("w", newline="", encoding="utf-8") as stream:
        csv.writer(stream, lineterminator="\n").writerows([heads, *rows])
    counts = Counter((robot, name) for robot, name, _ in lost)
    kinds = [[robot, name, str(count)] for (robot, name), count in counts.items()]
    parts = [markdown_table(["robot", "targets", "missed"], kinds)]
    parts.append(f"The first of them; all {len(lost)} are in [{path.name}]({path.name}).")
    return [*parts, markdown_table(heads, rows[:SHOWN])]
