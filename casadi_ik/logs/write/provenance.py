"""Where a log comes from: code, packages, machine, parameters."""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.logs.mcap.clock import ITERATION, LogClock
from casadi_ik.logs.mcap.metadata import CHECKSUM, FORMAT, checksum

PACKAGES = ("casadi", "numpy", "mcap", "pin", "proxsuite", "msgspec", "pyyaml")


def log_metadata(
    robot_name: str,
    seed: int,
    parameters: Mapping[str, Any],
    keep: Mapping[str, Any],
    compression: str,
    clock: LogClock,
) -> dict[str, str]:
    """The metadata record of a log: text by key; structured values as JSON."""
    record = {
        "format": FORMAT,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "robot": robot_name,
        "seed": str(seed),
        "keep": json.dumps(keep),
        "t0_ns": str(clock.t0),
        "slot_ns": str(clock.slot),
        "iteration_ns": str(ITERATION),
        "compression": compression,
        "code_version": _version("casadi-ik"),
        "packages": json.dumps(package_versions(PACKAGES)),
        "python": platform.python_version(),
        "machine": json.dumps(machine()),
        "parameters": json.dumps(plain(parameters)),
    }
    return {**record, CHECKSUM: checksum(record)}


def machine() -> dict[str, Any]:
    """What it runs on: system, processor, cores."""
    return {"system": platform.platform(), "processor": _processor(), "cores": os.cpu_count()}


def package_versions(names: Iterable[str]) -> dict[str, str]:
    """Versions of installed packages by name."""
    return {name: _version(name) for name in names}


def plain(value: Any) -> Any:
    """A value as standard JSON can hold it: arrays as lists, NaN and infinity as text."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return str(value)


@cache
def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


@cache
def _processor() -> str:
    """The processor's name; what the platform module says where the kernel tells nothing."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor())
