"""The report of the study: tables, figures, words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from runner import Metric, Study, code_of, provenance, read_results, write_metrics, write_page

from casadi_ik.errors import InputError
from qiu_table.figures import draw_convergence, draw_iterations, draw_success
from qiu_table.tables import by_object, by_setting, endings, readings, summary

NOT_RUN = "*Not run yet.*"
TITLE = "Table I of Qiu & Kermani 2021, measured again"

INTRODUCTION = """
*Targets.* Each of the 12 shipped grasps (computed pinches of YCB objects) keeps its hand posture;
the arm is drawn uniformly within its limits, and forward kinematics gives contact points and
normals that are reachable by construction (section III of the paper). *Solved:* every contact
within 5 mm and 3 deg; "within limits" asks besides that every joint is within its limits, and the
method keeps to them in every iteration. *One start* from the robot's home for the paper's methods,
at most 10,000 iterations. Means of iterations and time are over solved cases, as in the paper.
Intervals are 95 % confidence (Wilson's for rates). `n` is the number of targets.

The paper prints six of its twelve objects; its means here are over those six. It publishes
neither its grasps, nor its start as numbers, nor whether limits were enforced: the grasps and so
the targets are our own. Its "Can" stands beside our tomato soup can, which is a guess, and of that
can's enhanced DLS it prints time and iterations the wrong way round (put right here). Times are
those of the compiled loops on this machine while others were at work on it, beside MATLAB's: an
order of magnitude, no more.
"""

DIFFERENCES = """
What the original methods are, the paper says only as "the methods without the enhancement of the
proposed approach". No reading of it gives both its rate and its iterations: those that solve as
few targets take longer for them, and those that are as quick solve many more. Taken as
`original-*` is the reading whose rates are closest for both ways of solving a task: strict
priorities with exact projectors, finger by finger, the thumb first.
"""

CYCLES = """
A solve of a paper's method ends early only if it provably repeats: its state has come back bit for
bit, and since a step is a function of the state it will for ever (STALLED). All others that fail
count to 10,000 (ITERATION_LIMIT). Few come back: the original methods creep on for ever, because
what the lower tasks ask leaks through the projectors where tasks conflict, and cycles of the
enhanced ones mostly do not close to the last bit.
"""

ABLATION = """
One choice changed at a time, limits ignored, on the first targets of every object: the same
targets for every line, so differences are more certain than the intervals look.
"""


def write_report(studies: Sequence[Study], results: Path, folder: Path) -> None:
    """Write `report.md`, `report.html`, figures and `metrics.json`.

    Args:
        studies: The table, the ablation and the readings.
        results: Folder with a folder per study.
        folder: Where the report goes.

    Raises:
        InputError: There are no results of the table.
    """
    table, ablation, found = (read_results(study, results / study.name) for study in studies)
    if not len(table):
        raise InputError(f"{results}: found no results of the table, expected some")
    folder.mkdir(parents=True, exist_ok=True)
    draw_success(table, folder / "success.png")
    draw_iterations(table, folder / "iterations.png")
    draw_convergence(studies[0], table, folder / "convergence.png")
    metrics: list[Metric] = []

    def kept(made: tuple[str, list[Metric]]) -> str:
        metrics.extend(made[1])
        return made[0]

    parts = [
        INTRODUCTION,
        "## All objects",
        kept(summary(table)),
        "![Success by object](success.png)",
        "![Iterations of solved cases](iterations.png)",
        "## Convergence",
        "The worst error over all contacts in units of its tolerance, limits ignored, of the first "
        "targets that were solved and the first that were not.",
        "![Convergence of solved and failed runs](convergence.png)",
        "## How solves end",
        CYCLES,
        endings(table),
        "## The paper's open choices: enhanced methods",
        ABLATION,
        kept(by_setting(ablation, studies[1])) if len(ablation) else NOT_RUN,
        "## Readings of the original methods",
        DIFFERENCES,
        kept(readings(found, studies[2])) if len(found) else NOT_RUN,
        "## Every object",
        kept(by_object(table)),
        "## Where this comes from",
        provenance({study.name: code_of(results / study.name) for study in studies}),
        f"Seed {studies[0].seed}. To go on where this stopped: "
        "`python studies/table_one.py --full --jobs 2`.",
    ]
    write_page(TITLE, parts, folder)
    write_metrics(metrics, folder / "metrics.json")
