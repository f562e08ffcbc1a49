"""Reports: figures with their confidence, tables, pages, and where they come from."""

from __future__ import annotations

import dataclasses
import json
import math
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from casadi_ik.compile.compiler import find_compiler
from casadi_ik.errors import CasadiIKError
from casadi_ik.logs.format import machine, package_versions

Z95 = 1.959963984540054
"""Quantile of the normal distribution for 95 % confidence."""


@dataclass(frozen=True)
class Metric:
    """A figure.

    Attributes:
        name: What it is of, from the general to the particular, separated by slashes.
        value: The figure; NaN if there is nothing to take it from.
        unit: Its unit.
        better: "higher" or "lower".
        low: Lower end of its 95 % confidence interval.
        high: Upper end.
        n: Number of samples behind it.
    """

    name: str
    value: float
    unit: str
    better: str
    low: float
    high: float
    n: int


def rate_metric(name: str, successes: int, n: int) -> Metric:
    """Return a success rate in percent with the interval of Wilson (1927)."""
    if n == 0:
        return Metric(name, math.nan, "%", "higher", 0.0, 100.0, 0)
    share, z2 = successes / n, Z95**2
    middle = (share + z2 / (2 * n)) / (1 + z2 / n)
    half_width = Z95 * math.sqrt(share * (1 - share) / n + z2 / (4 * n * n)) / (1 + z2 / n)
    low, high = max(0.0, middle - half_width), min(1.0, middle + half_width)
    # At the ends rounding would leave the interval a hair off the rate.
    low, high = (0.0 if successes == 0 else low), (1.0 if successes == n else high)
    return Metric(name, 100 * share, "%", "higher", 100 * low, 100 * high, n)


def mean_metric(name: str, values: ArrayLike, unit: str, better: str = "lower") -> Metric:
    """Return a mean with the normal interval of its standard error."""
    samples = np.asarray(values, dtype=float)
    if len(samples) == 0:
        return Metric(name, math.nan, unit, better, math.nan, math.nan, 0)
    value = float(samples.mean())
    spread = float(samples.std(ddof=1)) if len(samples) > 1 else math.nan
    half_width = Z95 * spread / math.sqrt(len(samples))
    # Of what cannot be negative the mean is not either, however few samples there are.
    low = max(value - half_width, 0.0) if samples.min() >= 0 else value - half_width
    return Metric(name, value, unit, better, low, value + half_width, len(samples))


def median_metric(name: str, values: ArrayLike, unit: str, better: str = "lower") -> Metric:
    """Return a median with the interval between order statistics (normal approximation)."""
    samples = np.sort(np.asarray(values, dtype=float))
    n = len(samples)
    if n == 0:
        return Metric(name, math.nan, unit, better, math.nan, math.nan, 0)
    half_width = Z95 * math.sqrt(n) / 2
    low = samples[max(0, math.floor(n / 2 - half_width))]
    high = samples[min(n - 1, math.ceil(n / 2 + half_width))]
    return Metric(name, float(np.median(samples)), unit, better, float(low), float(high), n)


def interval_text(metric: Metric, digits: int = 1) -> str:
    """Format a value and its interval as "97.4 (97.1-97.7)"; a dash if there is none."""
    if math.isnan(metric.value):
        return "-"
    if math.isnan(metric.low):
        return f"{metric.value:.{digits}f}"
    return f"{metric.value:.{digits}f} ({metric.low:.{digits}f}\u2013{metric.high:.{digits}f})"


def write_metrics(metrics: Iterable[Metric], path: Path) -> None:
    """Write figures as JSON, one per line; NaN as null."""
    rows = []
    for metric in metrics:
        entry = dataclasses.asdict(metric)
        rows.append(
            {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in entry.items()}
        )
    lines = ",\n ".join(json.dumps(row) for row in rows)
    path.write_text(f"[\n {lines}\n]\n", encoding="utf-8")


MAX_COLUMNS = 8
"""Columns of a table; a wider one is divided."""


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table with the first column left-aligned and the others right-aligned.

    A table of more than `MAX_COLUMNS` becomes several that repeat the columns that identify a row.
    """
    return "\n".join(
        "".join(f"| {' | '.join(line[i] for i in columns)} |\n" for line in (heads, rule, *rows))
        for columns in column_groups(rows, len(heads))
        for rule in [["---", *["---:"] * (len(heads) - 1)]]
    )


def column_groups(rows: Sequence[Sequence[str]], count: int) -> list[list[int]]:
    """Divide the columns of a table into groups that start with the columns that identify a row."""
    if count <= MAX_COLUMNS:
        return [list(range(count))]
    identified = (k for k in range(1, 5) if len({tuple(row[:k]) for row in rows}) == len(rows))
    keys = next(identified, 1)
    groups = np.array_split(np.arange(keys, count), -(-(count - keys) // (MAX_COLUMNS - keys)))
    return [[*range(keys), *group.tolist()] for group in groups]


def page(title: str, result: str, parts: Sequence[str]) -> str:
    """Return the text of a report: its title, its result in bold, and Markdown blocks."""
    return "\n\n".join((f"# {title}", f"**{result}**", *(part.strip() for part in parts))) + "\n"


def publish(
    title: str,
    result: str,
    parts: Sequence[str],
    folder: Path,
    run_by: str,
    code: Mapping[str, str | None] | None = None,
    metrics: Iterable[Metric] = (),
) -> None:
    """Write `report.md`, which ends with its provenance, and `metrics.json`.

    Args:
        title: Title of the page.
        result: Sentence that states the main result; computed from the results, so that it stays
            true when the study is repeated.
        parts: Markdown blocks; figures by their names in the folder.
        folder: Folder of the report, created if it does not exist.
        run_by: Command that made the report, see `command`.
        code: Versions of the code, see `provenance`.
        metrics: Metrics to store; without any, no `metrics.json` is written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    end = ["## Provenance", f"`{run_by}`", provenance(code or {})]
    (folder / "report.md").write_text(page(title, result, [*parts, *end]), encoding="utf-8")
    if figures := list(metrics):
        write_metrics(figures, folder / "metrics.json")


PACKAGES = ("casadi-ik", "casadi", "numpy", "polars", "joblib", "dask")


def provenance(code: Mapping[str, str | None]) -> str:
    """Return a paragraph on machine, packages and sources, as Markdown.

    Args:
        code: Version of the code the results of every study were made with (`code_of`).
    """
    on = machine()
    compiler = find_compiler()
    versions = ", ".join(f"{name} {text}" for name, text in package_versions(PACKAGES).items())
    code_versions = {name: text for name, text in code.items() if text is not None}
    sources = ", ".join(f"{name} `{text}`" for name, text in code_versions.items())
    return (
        f"Machine: {on['processor']}, {on['cores']} cores, {on['system']}; "
        f"{compiler.version if compiler else 'no C compiler'}. Packages: {versions}. Sources "
        f"(version and digest): {sources}; report written at commit "
        f"`{commit(Path(__file__).parent)}`."
    )


def commit(folder: Path) -> str:
    """Return the commit that is checked out in a folder."""
    command = ["git", "-C", str(folder), "rev-parse", "--short=12", "HEAD"]
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except OSError:
        return "unknown"
    return done.stdout.strip() or "unknown"


def program(main: Callable[[], None]) -> None:
    """Run a study's `main`; bad input ends it with one line and exit code 2."""
    try:
        main()
    except CasadiIKError as error:
        sys.exit(_refused(str(error)))
    except KeyboardInterrupt:
        print("stopped; the same command goes on", file=sys.stderr)
        sys.exit(130)


def _refused(text: str) -> int:
    print(f"{Path(sys.argv[0]).name}: error: {text}", file=sys.stderr)
    return 2


def command(script: str, arguments: Sequence[str] | None) -> str:
    """Return the command that was run, quoted for a shell.

    Args:
        script: `__file__` of the study.
        arguments: What its `main` was given; None: the words of the process.
    """
    words = sys.argv[1:] if arguments is None else arguments
    return shlex.join(["python", f"studies/{Path(script).name}", *map(str, words)])
