"""The report of the study: tables, figures, words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import polars as pl
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
within 5 mm and 3 deg; "within limits" also asks that every joint is within its limits, and the
method keeps to them in every iteration. *One start* from the robot's home for the paper's methods,
at most 10,000 iterations. Means of iterations and time are over solved cases, as in the paper.
Intervals are 95 % confidence (Wilson's for rates). `n` is the number of targets; the paper's is
120,000. Where less was run the targets are the first of every object, as many of each.

The paper prints six of its twelve objects; its means here are over those six. It publishes
neither its grasps, nor its start as numbers, nor whether limits were enforced: the grasps and so
the targets are our own. Its "Can" stands beside our tomato soup can, which is a guess, and of that
can's enhanced DLS it prints time and iterations the wrong way round (put right here). Times are
a solve's share of the compiled loop, which makes four at once, on this machine while others were at
work on it, beside MATLAB's: an order of magnitude, no more.
"""

DIFFERENCES = """
What the original methods are, the paper says only as "the methods without the enhancement of the
proposed approach". Every reading below is on the same targets, limits ignored. The distance is
|ln(rate / printed rate)| + |ln(iterations / printed iterations)|. Most readings solve several times
as many targets as the paper prints; few they become only under an augmented projection: with
damped pseudoinverses in the projectors and the palm first, or with exact ones finger by finger.
The methods of the paper differ in the step alone, so one reading has to serve both: taken as
`original-*` is "augmented, damped projectors, palm first, finger by finger", which carries the
paper's own hierarchy of thumb reaching on to the other fingers. The last table says how it compares
with the others for both methods together; for one method alone another may come closer.
"""

CYCLES = """
A solve of a paper's method ends early only if it provably repeats: its state has come back bit for
bit, and since a step is a function of the state it will for ever (STALLED). All others that fail
count to 10,000 (ITERATION_LIMIT): they creep on where tasks conflict, or go round a cycle that
closes only to rounding, not to the last bit. "Iterations saved" is the share of all iterations that
the proofs spared.
"""

ABLATION = """
One choice changed at a time, limits ignored, on the first targets of every object: the same
targets for every line, so differences are more certain than the intervals look.
"""


def write_report(studies: Sequence[Study], results: Path, folder: Path, command: str) -> None:
    """Write `report.md`, `report.html`, figures and `metrics.json`.

    Args:
        studies: The table, its part by the original methods, the ablation and the readings.
        results: Folder with a folder per study.
        folder: Where the report goes.
        command: What was run.

    Raises:
        InputError: There are no results of the table.
    """
    fast, slow, ablation, found = (read_results(study, results / study.name) for study in studies)
    table = pl.concat([fast, slow], how="diagonal")
    if not len(table):
        raise InputError(f"{results}: found no results of the table, expected some")
    folder.mkdir(parents=True, exist_ok=True)
    draw_success(table, folder / "success.png")
    draw_iterations(table, folder / "iterations.png")
    draw_convergence(studies[:2], table, folder / "convergence.png")
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
        "Dashed: the mean that the paper prints for the method of that colour.",
        "## Convergence",
        "The worst error over all contacts in units of its tolerance, limits ignored, of the first "
        "targets that were solved and the first that were not.",
        "![Convergence of solved and failed runs](convergence.png)",
        "## How solves end",
        CYCLES,
        endings(table),
        "## The paper's open choices: enhanced methods",
        ABLATION,
        kept(by_setting(ablation, studies[2])) if len(ablation) else NOT_RUN,
        "## Readings of the original methods",
        DIFFERENCES,
        kept(readings(found, studies[3])) if len(found) else NOT_RUN,
        "## Every object",
        kept(by_object(table)),
        "## Where this comes from",
        provenance({study.name: code_of(results / study.name) for study in studies}),
        f"Seed {studies[0].seed}. Made by, and to go on where it stopped: `{command}`.",
    ]
    write_page(TITLE, parts, folder)
    write_metrics(metrics, folder / "metrics.json")
