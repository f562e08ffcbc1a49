"""The metadata record that makes an MCAP file a log of ours, checked before it is believed."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import msgspec
from mcap.records import Metadata

from casadi_ik.errors import LogError
from casadi_ik.logs.mcap.clock import ITERATION, LogClock

METADATA_NAME = "casadi_ik"
"""Name of the metadata record."""

FORMAT = "2"
"""Version of the log's own conventions (topics, schemas, metadata)."""

CHECKSUM = "crc32"
"""Key of the checksum of all other entries."""

SHARDS = "shards"
"""Key of where the solves of a merged log come from."""

DEPTH = 32
"""How deep lists and mappings may be nested."""

_TOO_DEEP = f"lists and mappings are nested more than {DEPTH} deep"

_JSON = ("packages", "machine", "parameters", "keep")

Number = Annotated[str, msgspec.Meta(pattern=r"^[0-9]{1,19}\Z")]
Text = Annotated[str, msgspec.Meta(max_length=10_000)]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=200)]


class _Record(msgspec.Struct):
    """What must be in the record, and of what kind; other entries are let through as text."""

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


def checksum(record: Mapping[str, str]) -> str:
    """CRC-32 of the entries but itself: MCAP has no checksum for metadata."""
    entries = sorted((key, text) for key, text in record.items() if key != CHECKSUM)
    return f"{zlib.crc32(json.dumps(entries).encode()):08x}"


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
    if record.get(CHECKSUM) != checksum(record):
        raise LogError("the log is damaged: its metadata fail their checksum")
    if record.get("format") != FORMAT:
        raise LogError(f"format: found {record.get('format', '')[:20]!r}, expected {FORMAT!r}")
    return record


def values_of(record: Mapping[str, str]) -> Mapping[str, Any]:
    """The entries of our record, structured ones as what they say.

    Raises:
        LogError: One is missing or of the wrong kind.
    """
    values = {key: _parsed(key, text) if key in _JSON else text for key, text in record.items()}
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


def parsed_json(what: str, text: str) -> Any:
    """JSON from a log.

    Args:
        what: What it is, for the message.
        text: The JSON.

    Raises:
        LogError: It is none, or nested too deeply.
    """
    try:
        value = json.loads(text)
    except ValueError as error:
        raise LogError(f"{what}: not JSON: {error}") from error
    except RecursionError as error:
        raise LogError(f"{what}: {_TOO_DEEP}") from error
    if not _shallow(value, DEPTH):
        raise LogError(f"{what}: {_TOO_DEEP}")
    return value


def _parsed(key: str, text: str) -> Any:
    return parsed_json(f"metadata: {key}", text)


def _shallow(value: Any, left: int) -> bool:
    if isinstance(value, dict | list):
        items = value.values() if isinstance(value, dict) else value
        return left > 0 and all(_shallow(item, left - 1) for item in items)
    return True
