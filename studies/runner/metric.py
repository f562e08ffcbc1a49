"""Every figure of a study with unit, direction and confidence."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

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
    """A success rate in percent with the interval of Wilson (1927)."""
    if n == 0:
        return Metric(name, math.nan, "%", "higher", 0.0, 100.0, 0)
    share, z2 = successes / n, Z95**2
    middle = (share + z2 / (2 * n)) / (1 + z2 / n)
    half = Z95 * math.sqrt(share * (1 - share) / n + z2 / (4 * n * n)) / (1 + z2 / n)
    low, high = max(0.0, middle - half), min(1.0, middle + half)
    # At the ends rounding would leave the interval a hair off the rate.
    low, high = (0.0 if successes == 0 else low), (1.0 if successes == n else high)
    return Metric(name, 100 * share, "%", "higher", 100 * low, 100 * high, n)


def mean_metric(name: str, values: ArrayLike, unit: str, better: str = "lower") -> Metric:
    """A mean with the normal interval of its standard error."""
    samples = np.asarray(values, dtype=float)
    if len(samples) == 0:
        return Metric(name, math.nan, unit, better, math.nan, math.nan, 0)
    value = float(samples.mean())
    spread = float(samples.std(ddof=1)) if len(samples) > 1 else math.nan
    half = Z95 * spread / math.sqrt(len(samples))
    # Of what cannot be negative the mean is not either, however few samples there are.
    low = max(value - half, 0.0) if samples.min() >= 0 else value - half
    return Metric(name, value, unit, better, low, value + half, len(samples))


def median_metric(name: str, values: ArrayLike, unit: str, better: str = "lower") -> Metric:
    """A median with the interval between order statistics (normal approximation)."""
    samples = np.sort(np.asarray(values, dtype=float))
    n = len(samples)
    if n == 0:
        return Metric(name, math.nan, unit, better, math.nan, math.nan, 0)
    half = Z95 * math.sqrt(n) / 2
    low = samples[max(0, math.floor(n / 2 - half))]
    high = samples[min(n - 1, math.ceil(n / 2 + half))]
    return Metric(name, float(np.median(samples)), unit, better, float(low), float(high), n)


def interval_text(metric: Metric, digits: int = 1) -> str:
    """The figure and its interval as "97.4 (97.1-97.7)"; a dash if there is none."""
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
