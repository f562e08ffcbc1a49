"""Where a log comes from: the metadata record, written by a recorder and checked by a reader."""

from __future__ import annotations

import json
import math
import os
import platform
import zlib
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from mcap.records import Metadata

from casadi_ik.errors import LogError
from casadi_ik.logs.format import ITERATION, LogClock

METADATA_NAME = "casadi_ik"
"""Name of the metadata record."""

FORMAT = "2"
"""Version of the log's own conventions (topics, schemas, metadata)."""

CHECKSUM = "crc32"
"""Key of the checksum of all other entries: MCAP has none for metadata."""

SHARDS = "shards"
"""Key of where the solves of a merged log come from."""

PACKAGES = ("casadi", "numpy", "mcap", "proxsuite", "msgspec", "pyyaml")

Number = Annotated[str, msgspec.Meta(pattern=r"^[0-9]{1,19}\Z")]
Text = Annotated[str, msgspec.Meta(max_length=10_000)]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=200)]


class _Record(msgspec.Struct):
    """Entries of the record and their kinds; other entries are let through as text."""

    robot: Name
    seed: Text
    t0_ns: Number
    slot_ns: Number
    keep: dict[str, Any] = {}
    packages: dict[str, Text] = {}
    machine: dict[str, Any] = {}
    parameters: dict[str, Any] = {}
    iteration_ns: Number = str(ITERATION)
    compression: Text = ""
    created: Text = ""
    python: Text = ""
    code_version: Text = ""


def log_metadata(
    robot_name: str,
    seed: int,
    parameters: Mapping[str, Any],
    keep: Mapping[str, Any],
    compression: str,
    clock: LogClock,
) -> dict[str, str]:
    """The metadata record of a log: text by key; structured values as JSON."""
    return signed(
        {
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
    )


def signed(record: Mapping[str, str]) -> dict[str, str]:
    """The entries with their checksum."""
    entries = sorted((key, text) for key, text in record.items() if key != CHECKSUM)
    return {**record, CHECKSUM: f"{zlib.crc32(json.dumps(entries).encode()):08x}"}


def machine() -> dict[str, Any]:
    """The computer: system, processor, cores."""
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


def own_record(records: Sequence[Metadata]) -> Mapping[str, str]:
    """Our record among those of a file.

    Raises:
        LogError: There is none, there are several, it fails its checksum, or it is of a version
            that is not known here.
    """
    found = [record.metadata for record in records if record.name == METADATA_NAME]
    if len(found) != 1:
        names = ", ".join(sorted({repr(record.name)[1:-1] for record in records})) or "none"
        problem = f"metadata {METADATA_NAME!r} twice" if found else f"no metadata {METADATA_NAME!r}"
        raise LogError(f"not a log of casadi_ik: {problem} (found: {names})")
    (record,) = found
    if record != signed(record):
        raise LogError("the log is damaged: its metadata fail their checksum")
    if record.get("format") != FORMAT:
        raise LogError(f"format: found {record.get('format', '')[:20]!r}, expected {FORMAT!r}")
    return record


def values_of(record: Mapping[str, str]) -> Mapping[str, Any]:
    """The entries of our record, structured ones as what they say.

    Raises:
        LogError: One is missing or of the wrong kind.
    """
    values = {
        key: parsed_json(f"metadata: {key}", text, dict[str, Any])
        if key in ("packages", "machine", "parameters", "keep")
        else text
        for key, text in record.items()
    }
    try:
        found = msgspec.convert(values, _Record)
    except msgspec.ValidationError as error:
        text, _, place = str(error).partition(" - at `$.")
        raise LogError(f"metadata: {place.rstrip('`') or 'record'}: {text}") from error
    if found.iteration_ns != str(ITERATION):
        raise LogError(f"metadata: iteration_ns: found {found.iteration_ns}, expected {ITERATION}")
    return {**msgspec.structs.asdict(found), **values}


def clock_of(values: Mapping[str, Any]) -> LogClock:
    """The rule of a log's times.

    Raises:
        LogError: It leaves no time for an iteration.
    """
    t0, slot = int(values["t0_ns"]), int(values["slot_ns"])
    if not (t0 < 2**63 and ITERATION <= slot < 2**63):
        raise LogError(f"metadata: found t0_ns {t0}, slot_ns {slot}, which leave no time")
    return LogClock(t0, slot)


def parsed_json(what: str, text: str, kind: Any) -> Any:
    """JSON from a log.

    Args:
        what: Its name, for the message.
        text: The JSON.
        kind: The expected type.

    Raises:
        LogError: It is no JSON of that type, or nested too deeply.
    """
    too_deep = f"{what}: lists and mappings are nested more than 32 deep"
    try:
        value = json.loads(text)
        if not _shallow(value, 32):
            raise LogError(too_deep)
        return msgspec.convert(value, kind)
    except RecursionError as error:
        raise LogError(too_deep) from error
    except msgspec.ValidationError as error:
        raise LogError(f"{what}: {error}") from error
    except ValueError as error:
        raise LogError(f"{what}: not JSON: {error}") from error


def _shallow(value: Any, left: int) -> bool:
    if isinstance(value, dict | list):
        items = value.values() if isinstance(value, dict) else value
        return left > 0 and all(_shallow(item, left - 1) for item in items)
    return True


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
