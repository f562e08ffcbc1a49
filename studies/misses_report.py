"""Report of the study of misses: tables, causes of misses, and the map of arms and hands."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from climbing import read_search
from matplotlib.colors import LogNorm
from missed_targets import (
    ANGLES,
    DISTANCES,
    KINDS_OF_CONTACTS,
    REFERENCE,
    ROBOTS,
    SHARES,
    STARTS,
    Climb,
    Part,
    load,
    parts_of,
    robots_of,
    tolerance_name,
    tolerance_of,
)
from runner.figures import figure, title
from runner.parts import read_parts
from runner.report import (
    Metric,
    interval_text,
    markdown_table,
    publish,
    rate_metric,
)

import casadi_ik as ik
from casadi_ik.files.arrays import Array

MAX_LISTED = 30
"""Misses listed in the report; a file beside it has all of them."""

INTRODUCTION = """
All targets are contacts of configurations within limits and therefore reachable. *Missed:* the
verdict, which forward kinematics recomputes from the solution, finds a contact outside its
tolerance or a motor or joint outside its limits. *Hands on one arm:* hand postures are uniform,
the arm is at 60 % of its range. *Corners:* every motor is at its lower limit, at its upper limit,
or anywhere, with equal probability; *near limits:* within 1 deg (a slider: a fiftieth of its
stroke) of them. *Near-singular arms:* of 32 random arm configurations, the one whose palm
Jacobian has the smallest singular value. *Aligned arms:* elbow straight, shoulder or wrist
aligned, or all three, off by 1e-3 to 1e-9 rad. Intervals are Wilson intervals, 95 %. Times are of
single targets of a batch [us] and include other load on the machine.
"""

NOISY = """
*Noisy contacts:* Gaussian noise of {:g} mm on every coordinate of the points and of {:g} deg on
the normals, so that not all targets can be solved. *Possible:* the number of missed targets for
which Ipopt finds a configuration within tolerance (minimise t with every error at most t times
its tolerance) from the configuration before the noise, the solution or random starts, at most {}
starts.
"""

DISPLACEMENTS = """
Every point of the contacts of a configuration is displaced in a random direction by a share of the
position tolerance, and every normal is rotated about a random axis by that share of the angle
tolerance. The configuration itself is therefore a solution. The tolerances are all pairs of
{} deg and {} mm. The columns with shares have the solved targets in percent; the last two columns
have the tolerance with the fewest solved targets, and how many these are in percent.
"""

CLIMBING = """
Climbers walk over the configurations within limits, towards targets whose solve takes many
iterations (half of them also towards badly conditioned ones).
"""

CAUSES = """
Missed targets are solved again with all fingers. *Solved now:* by the code that wrote this page.
*Given the hand:* with the hand motors fixed at the configuration that made the target; such
targets were missed because no hand posture came near enough, the others because no arm
configuration carries the hand where it fits. *From nearby:* from a start within 0.1 of the range
of every motor. *At limits:* mean fraction of arm and hand motors within a thousandth of their
range from a limit. *Off:* the largest error of a contact in the best solution.
"""


def causes(robot: ik.ArmHand, tolerance: ik.Tolerance, q: Array) -> list[str]:
    """Return a row on the causes for configurations (k, n) whose contacts were missed."""
    points, normals = robot.contacts(q)
    solver = ik.Solver(robot, tolerance=tolerance)
    batch = solver.solve_batch(points, normals)
    left = np.flatnonzero(~batch.success)
    text = [f"{len(q)}", f"{len(q) - len(left)}"]
    if not len(left):
        return [*text, *5 * ["-"]]
    arm, hand = (
        list(motors)
        for motors in (robot.description.arm_actuators, robot.description.hand_actuators)
    )
    ranges, rng = robot.upper - robot.lower, np.random.default_rng(0)
    with_fixed_hand = near_start = 0
    for row in left.tolist():
        target = points[row : row + 1], normals[row : row + 1]
        fixed = {robot.actuators[i]: float(q[row, i]) for i in hand}
        with_fixed_hand += int(solver.solve_batch(*target, fixed=fixed).success[0])
        start = q[row] + 0.1 * ranges * rng.uniform(-1, 1, len(ranges))
        start = np.clip(start, robot.lower, robot.upper)
        near_start += int(solver.solve_batch(*target, q0=start).success[0])
    at_limits = np.minimum(q - robot.lower, robot.upper - q) < 1e-3 * ranges
    shares = [
        f"{100 * at_limits[left][:, motors].mean():.0f} %" if motors else "-"
        for motors in (arm, hand)
    ]
    off = 1e6 * np.median(np.nanmax(batch.position_error[left], axis=1))
    return [
        *text,
        f"{with_fixed_hand} of {len(left)}",
        f"{near_start} of {len(left)}",
        *shares,
        f"{off:.3g} um",
    ]


Row = dict[str, Any]


def rows_of(options: argparse.Namespace) -> tuple[list[Row], str]:
    """Return results by robot, kind and tolerance (many robots: kinds combined), and codes."""
    done, codes = read_parts(options.out, parts_of(options))
    has_many_robots = len(robots_of(options.robots)) > 2 * len(ROBOTS)
    groups: dict[tuple[str, str, str], list[tuple[Part, Row]]] = {}
    for part, result in done:
        if part.share:
            continue
        kind = "all kinds" if has_many_robots else part.kind
        groups.setdefault((part.robot, kind, part.tolerance), []).append((part, result))
    rows: list[Row] = []
    for (robot, kind, tolerance), results in groups.items():
        results_of_cell = [result for _, result in results]
        usual = [result["ratio"] for part, result in results if part.sampler == "random"]
        row: Row = {"robot": robot, "kind": kind, "tolerance": tolerance}
        row |= {
            key: sum(result[key] for result in results_of_cell)
            for key in ("count", "iterations", "restarted")
        }
        row["mean"] = 1e6 * sum(result["seconds"] for result in results_of_cell) / row["count"]
        row["most restarts"] = max(result["most restarts"] for result in results_of_cell)
        row["most iterations"] = max(result["most iterations"] for result in results_of_cell)
        median, slow, worst = zip(*(result["times"] for result in results_of_cell), strict=True)
        row["times"] = float(np.median(median)), float(np.median(slow)), max(worst)
        if options.ratio:
            row["ratio"] = max(result["ratio"] for result in results_of_cell)
            row["usual"] = float(np.mean(usual or [np.nan]))
        row["looked"] = sum(result.get("looked", 0) for result in results_of_cell)
        row["possible"] = sum(result.get("possible", 0) for result in results_of_cell)
        row["missed"] = [
            {"place": f"{part.kind}-{part.number:05d}, row {miss['row']}"} | miss
            for part, result in results
            for miss in result["missed"]
        ]
        rows.append(row)
    return rows, codes


def displaced_table(options: argparse.Namespace, metrics: list[Metric]) -> list[str]:
    """Return the result and the section of the report on displaced contacts; [] without any."""
    solved: dict[str, dict[tuple[str, float], tuple[int, int]]] = {}
    for part, counts in read_parts(options.out, parts_of(options))[0]:
        if part.share:
            by_robot, key = solved.setdefault(part.robot, {}), (part.tolerance, part.share)
            success, count = by_robot.get(key, (0, 0))
            success += counts["count"] - len(counts["missed"])
            by_robot[key] = success, count + counts["count"]
    if not solved:
        return []

    def percent(cells: Iterable[tuple[int, int]]) -> float:
        successes, counts = zip(*cells, strict=True)
        return 100 * sum(successes) / sum(counts)

    lines = []
    for robot, by_key in solved.items():
        shares = [
            f"{percent(cell for (_, value), cell in by_key.items() if value == share):.3f}"
            for share in SHARES
        ]
        by_tolerance = {
            tolerance: percent(cell for (value, _), cell in by_key.items() if value == tolerance)
            for tolerance, _ in by_key
        }
        worst = min(by_tolerance, key=by_tolerance.__getitem__)
        count = sum(count for _, count in by_key.values())
        cells = [tolerance_name(worst), f"{by_tolerance[worst]:.3f}"]
        lines.append([robot, f"{count:,}", *shares, *cells])
        success = sum(success for success, _ in by_key.values())
        metrics.append(rate_metric(f"misses/{robot}/displaced", success, count))
    cells = [cell for by_key in solved.values() for cell in by_key.values()]
    result = f"Of {sum(count for _, count in cells):,} displaced targets of {len(solved)} robots, "
    result += f"{percent(cells):.3f} % are solved."
    heads = ["robot", "n", *(f"at {share:g}" for share in SHARES), "worst tolerance", "solved %"]
    text = DISPLACEMENTS.format(*(", ".join(map(str, values)) for values in (ANGLES, DISTANCES)))
    return [result, "## Tolerances", text, markdown_table(heads, lines)]


def climbed_rows(options: argparse.Namespace) -> tuple[list[Row], str]:
    """Return the rows of the climbing search, and codes."""
    rows: list[Row] = []
    codes = set[str]()
    for robot in robots_of(options.robots) if "climb" in options.sampler else ():
        state = Climb(robot, 0, options).state
        if not state.exists():
            continue
        search_state = read_search(state)
        codes.add(search_state["code"])
        for tolerance in options.tolerance:
            iterations, restarts = search_state["hardest_by_tolerance"].get(tolerance, (0, 0))
            missed = [miss for miss in search_state["missed"] if miss["tolerance"] == tolerance]
            row: Row = {"robot": robot, "kind": "climbing", "tolerance": tolerance}
            row |= {"count": search_state["total"], "seconds": search_state["seconds"]}
            row |= {"most iterations": iterations, "most restarts": restarts}
            row["missed"] = [{"place": "climbing"} | miss for miss in missed]
            rows.append(row)
    return rows, ", ".join(sorted(codes))


def _missed_text(row: Row) -> str:
    """Return the number of misses by status, as text."""
    counts = Counter(miss["status"] for miss in row["missed"])
    words = ", ".join(f"{count} {name}" for name, count in counts.most_common())
    return f"{len(row['missed'])}" + (f" ({words})" if words else "")


def _first(row: Row, metrics: list[Metric]) -> list[str]:
    name = f"misses/{row['robot']}/{row['kind']}/{tolerance_name(row['tolerance'])}"
    rate = rate_metric(name, row["count"] - len(row["missed"]), row["count"])
    metrics.append(rate)
    cells = [row["robot"], row["kind"], tolerance_name(row["tolerance"]), f"{row['count']:,}"]
    return [*cells, _missed_text(row), interval_text(rate, 5)]


def table_of(rows: list[Row], metrics: list[Metric]) -> str:
    """Return the table of the sampled targets."""
    heads = ["robot", "targets", "tolerance", "n", "missed", "solved %", "iterations", "most"]
    heads += ["restarted %", "most restarts", "median [us]", "99 %", "worst", "mean"]
    heads += ["ratio, random", "largest"] if "ratio" in rows[0] else []
    noise = rows[0]["kind"].startswith(KINDS_OF_CONTACTS["noise"])
    lines = []
    for row in rows:
        cells = [f"{row['iterations'] / row['count']:.1f}", f"{row['most iterations']:,}"]
        cells += [f"{100 * row['restarted'] / row['count']:.2f}", f"{row['most restarts']}"]
        cells += [f"{time_:,.0f}" for time_ in (*row["times"], row["mean"])]
        cells += [f"{row[key]:.2f}" for key in ("usual", "ratio") if key in row]
        cells += [f"{row['possible']} of {row['looked']}"] if noise else []
        lines.append([*_first(row, metrics), *cells])
    return markdown_table([*heads, *(["possible"] if noise else [])], lines)


def climbed_table(rows: list[Row], metrics: list[Metric]) -> str:
    """Return the table of the climbing search."""
    heads = ["robot", "targets", "tolerance", "n", "missed", "solved %", "minutes"]
    lines = [
        [
            *(*_first(row, metrics), f"{row['seconds'] / 60:.1f}"),
            *(f"{row['most iterations']:,}", f"{row['most restarts']}"),
        ]
        for row in rows
    ]
    return markdown_table([*heads, "most iterations", "most restarts"], lines)


def causes_section(rows: list[Row]) -> list[str]:
    """Parts of the report on misses: causes, and the list."""
    missed_rows = [row for row in rows if row["missed"]]
    listed = [
        [row["robot"], tolerance_name(row["tolerance"]), miss["place"], miss["status"], text]
        for row in missed_rows
        for miss in row["missed"]
        for text in [" ".join(f"{x:.9g}" for x in miss["q"])]
    ]
    if not listed:
        return ["## Misses", "None."]
    cells = []
    for robot, tolerance in dict.fromkeys((row["robot"], row["tolerance"]) for row in missed_rows):
        matching_rows = [
            row for row in missed_rows if (row["robot"], row["tolerance"]) == (robot, tolerance)
        ]
        of_contacts = [row for row in matching_rows if row["kind"] != KINDS_OF_CONTACTS["palms"]]
        q = np.array([miss["q"] for row in of_contacts for miss in row["missed"]])
        if len(q):
            cause_row = causes(load(robot), tolerance_of(tolerance), q)
            cells.append([robot, tolerance_name(tolerance), *cause_row])
    heads = ["robot", "tolerance", "missed", "solved now", "of the rest, given the hand"]
    heads += ["from nearby", "arm motors at limits", "hand motors at limits", "off, median"]
    parts = ["## Why", CAUSES, markdown_table(heads, cells)] if cells else []
    names = ["robot", "tolerance", "target", "status", "q"]
    return [*parts, "## Misses", markdown_table(names, listed[:MAX_LISTED])]


def heat_map(rows: list[Row], path: Path) -> None:
    """Pairs of arm and hand: ratio of times as colour, misses as numbers, finest tolerance."""
    finest = min((row["tolerance"] for row in rows), key=lambda t: tolerance_of(t).position)
    pairs = {tuple(row["robot"].split("+")): row for row in rows if row["tolerance"] == finest}
    arms, hands = (sorted({pair[i] for pair in pairs}) for i in (0, 1))
    ratios = np.full((len(arms), len(hands)), np.nan)
    plot, grid = figure(1, 1, 3.0 + 0.32 * len(hands), 2.6 + 0.22 * len(arms))
    axes = grid[0, 0]
    for (arm, hand), row in pairs.items():
        i, j = arms.index(arm), hands.index(hand)
        ratios[i, j], missed = row["usual"], len(row["missed"])
        if missed:
            around = {"facecolor": "white", "edgecolor": "none", "pad": 1.0}
            axes.text(j, i, str(missed), ha="center", va="center", fontsize=9, color="#c0392b",
                      bbox=around)  # fmt: skip
    smallest, largest = float(np.nanmin(ratios)), float(np.nanmax(ratios))
    scale = LogNorm(smallest, largest)
    image = axes.imshow(ratios, cmap="YlGnBu", norm=scale, alpha=0.8, aspect="auto")
    axes.set_xticks(range(len(hands)), hands, rotation=45, ha="right")
    axes.set_yticks(range(len(arms)), arms)
    bar = plot.colorbar(image, ax=axes, shrink=0.7)
    ticks = [t for t in (0.5, 1, 2, 3, 5, 10, 20) if smallest <= t <= largest]
    bar.set_ticks(ticks, labels=[f"{t:g}" for t in ticks])
    bar.ax.minorticks_off()
    bar.set_label(f"time of a target over that of {REFERENCE}")
    name = (
        f"Random targets, {tolerance_name(finest)}; red: targets of all kinds missed; "
        "white: not asked"
    )
    title(axes, name, "hand", "arm")
    plot.tight_layout()
    plot.savefig(path)


def write_report(options: argparse.Namespace, run_by: str) -> None:
    """Write the report on what there is."""
    (sampled_rows, codes), (climbed, climbed_codes) = rows_of(options), climbed_rows(options)
    noise = [row for row in sampled_rows if row["kind"].startswith(KINDS_OF_CONTACTS["noise"])]
    rows, metrics = [row for row in sampled_rows if row not in noise], list[Metric]()
    total = sum(row["count"] for row in [*rows, *climbed])
    missed_count = sum(len(row["missed"]) for row in [*rows, *climbed])
    result, *tolerances = displaced_table(options, metrics) or [""]
    body = []
    if total or noise or not result:
        result = f"Of {total:,} reachable targets, {missed_count} are missed. {result}".strip()
        body = [INTRODUCTION]
    options.report.mkdir(parents=True, exist_ok=True)
    if options.ratio and rows and all("+" in row["robot"] for row in rows):
        heat_map(rows, options.report / "pairs.png")
        body += ["![time and misses of every pair](pairs.png)"]
    body += [table_of(rows, metrics)] if rows else []
    if noise:
        body += ["## Noisy contacts", NOISY.format(*options.noise, STARTS)]
        body += [table_of(noise, metrics)]
    body += tolerances
    if climbed:
        body += ["## Climbing", CLIMBING, climbed_table(climbed, metrics)]
    body += causes_section([*rows, *climbed]) if total or not tolerances else []
    if missed_count > MAX_LISTED:
        misses = [
            {"robot": row["robot"], "kind": row["kind"], "tolerance": row["tolerance"]}
            | {"status": miss["status"], "q": " ".join(map(repr, miss["q"]))}
            for row in [*rows, *climbed]
            for miss in row["missed"]
        ]
        pl.DataFrame(misses).write_csv(options.report / "misses.csv")
    code = ", ".join(sorted({codes, climbed_codes} - {""})) or None
    publish(options.title, result, body, options.report, run_by, {"misses": code}, metrics)
