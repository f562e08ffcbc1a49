"""Are contacts with noise solved whenever the tolerance has room for it?

Contacts of random configurations get Gaussian noise: every coordinate of a point, and every
coordinate of a normal before it is made a unit vector again. Contacts then contradict each other,
and some cannot be met at all. What is solved is proved to be possible by its configuration; what is
not solved is given to Ipopt, which looks for the smallest factor by which all tolerances would have
to be multiplied, from the configuration without noise, from the answer and from random ones::

    python studies/noise.py --out out/noise
    python studies/noise.py --out out/noise --before out/before/figures.json  # beside other code's
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from minimax.program import MinimaxProgram
from rich.console import Console
from runner import markdown_table, write_page

import casadi_ik as ik
from casadi_ik.arrays import Array

LEVELS = ((1.0, 0.5), (2.0, 1.0), (3.0, 1.5), (4.0, 2.0), (5.0, 2.5))
"""Standard deviations of a coordinate of a point [mm], and of a normal [deg]."""

TOLERANCE = ik.Tolerance()

INTRODUCTION = """
Contacts of uniformly random configurations with Gaussian noise: *noise* is the standard deviation
of every coordinate of the points and (as an angle) of the normals. Tolerance 5 mm and 3 deg.
*Solved:* every contact within tolerance and all within limits, recomputed from the answer.
*Possible but missed:* not solved, though Ipopt shows a configuration within tolerance (minimise t
with every error at most t times its tolerance; the starts are the configuration before the noise,
the answer, and random ones). *Of the possible:* solved by solved and missed together. *Mean time:*
of a solve in a batch, everything included, while others were at work on the machine.
"""


@dataclass(frozen=True)
class Case:
    """A robot and the fingers that have contacts."""

    robot: str
    fingers: tuple[str, ...]

    @property
    def name(self) -> str:
        """As it is shown."""
        return f"{self.robot} ({', '.join(self.fingers)})"


CASES = (
    Case("kuka_lwr_barrett", ("thumb", "finger_2", "finger_3")),
    Case("baxter_ar10", ("thumb", "index", "middle")),
    Case("ar10", ("thumb", "index", "middle")),
    Case("panda+allegro_right", ("thumb", "index", "middle", "ring")),
)


@dataclass(frozen=True)
class Figures:
    """What came of a case at a level of noise."""

    count: int
    solved: int
    missed: int
    looked: int
    mean_time: float
    worst_factor: float


def noisy(
    robot: ik.ArmHand, rng: np.random.Generator, count: int, level: tuple[float, float]
) -> tuple[Array, Array, Array]:
    """Configurations (k, n) and their contacts with noise, (k, f, 3) each."""
    q = robot.random(rng, count)
    points, normals = robot.contacts(q)
    points = points + rng.normal(0, 1e-3 * level[0], points.shape)
    normals = normals + rng.normal(0, np.radians(level[1]), normals.shape)
    return q, points, normals / np.linalg.norm(normals, axis=2, keepdims=True)


def measure(
    case: Case, level: tuple[float, float], count: int, looked: int, starts: int, seed: int
) -> Figures:
    """Solve the targets of a case, and look closer at some of those not solved."""
    robot = ik.load_robot(case.robot)
    rng = np.random.default_rng([seed, int(10 * level[0])])
    q, points, normals = noisy(robot, rng, count, level)
    free = [name not in case.fingers for name in robot.fingers]
    points[:, free] = normals[:, free] = np.nan
    solver = ik.Solver(robot, tolerance=TOLERANCE)
    solver.solve_batch(points[:8], normals[:8])
    begin = time.process_time()
    batch = solver.solve_batch(points, normals)
    seconds = time.process_time() - begin
    rows = np.flatnonzero(~batch.success)[:looked]
    program = MinimaxProgram(robot, TOLERANCE, case.fingers) if len(rows) else None
    factors = []
    for row in rows.tolist():
        assert program is not None
        begun = robot.random(np.random.default_rng([seed, row]), starts)
        begun[0], begun[1] = q[row], batch.q[row]
        factors.append(program.nearest(points[row], normals[row], begun).factor)
    missed = sum(factor <= 1 for factor in factors)
    return Figures(
        count, int(batch.success.sum()), missed, len(rows), seconds / count, min(factors, default=1)
    )


def write_report(
    found: dict[str, Figures], before: dict[str, Figures], folder: Path, seed: int, starts: int
) -> None:
    """Write tables, beside what other code came to."""
    parts = [INTRODUCTION, f"Seed {seed}; at most {starts} starts of Ipopt for a target."]
    for case in CASES:
        rows = []
        for level in LEVELS:
            key = _key(case, level)
            if key not in found:
                continue
            one, other = found[key], before.get(key)
            rows.append(
                [
                    f"{level[0]:g} mm, {level[1]:g} deg",
                    f"{one.count:,}",
                    *_columns(other),
                    *_columns(one),
                ]
            )
        if not rows:
            continue
        heads = ["noise", "targets"]
        for when in ("before", "now"):
            heads += [f"solved % ({when})", f"possible but missed ({when})"]
            heads += [f"of the possible % ({when})", f"mean time [us] ({when})"]
        parts += [f"## {case.name}", markdown_table(heads, rows)]
    parts.append(
        "*Missed a of b:* only b of those not solved were looked at; the share of the possible "
        "counts the others alike."
    )
    write_page("Contacts with noise", parts, folder)


def _columns(figures: Figures | None) -> Sequence[str]:
    if figures is None:
        return ["-"] * 4
    unsolved = figures.count - figures.solved
    share = figures.missed * unsolved / figures.looked if figures.looked else 0.0
    return [
        f"{100 * figures.solved / figures.count:.2f}",
        f"{figures.missed} of {figures.looked}",
        f"{100 * figures.solved / max(figures.solved + share, 1):.2f}",
        f"{1e6 * figures.mean_time:.0f}",
    ]


def _key(case: Case, level: tuple[float, float]) -> str:
    return f"{case.robot} {level[0]:g}"


def _read(path: Path | None) -> dict[str, Figures]:
    if path is None or not path.exists():
        return {}
    return {key: Figures(**one) for key, one in json.loads(path.read_text()).items()}


def main(arguments: list[str] | None = None) -> None:
    """Measure, and write figures and report."""
    parser = argparse.ArgumentParser(description="Success of hand-first on contacts with noise.")
    parser.add_argument("--count", type=int, default=5000, help="targets per robot and level")
    parser.add_argument(
        "--looked", type=int, default=30, help="of those not solved, given to Ipopt"
    )
    parser.add_argument("--starts", type=int, default=50, help="of Ipopt for a target")
    parser.add_argument("--seed", type=int, default=2024)
    parser.add_argument("--robot", action="append", help="only this one")
    parser.add_argument("--levels", type=float, nargs="+", help="noise of the points [mm]")
    parser.add_argument("--out", type=Path, default=Path("out/noise"), help="folder of the report")
    parser.add_argument("--before", type=Path, help="figures.json of other code, to be set beside")
    options = parser.parse_args(arguments)
    path = options.out / "figures.json"
    found = _read(path)
    for case in CASES:
        for level in LEVELS:
            if options.levels and level[0] not in options.levels:
                continue
            if options.robot and case.robot not in options.robot:
                continue
            figures = measure(
                case, level, options.count, options.looked, options.starts, options.seed
            )
            found[_key(case, level)] = figures
            Console().print(case.robot, *level, asdict(figures))
            options.out.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps({key: asdict(one) for key, one in found.items()}, indent=2))
    write_report(found, _read(options.before), options.out, options.seed, options.starts)


if __name__ == "__main__":
    main()
