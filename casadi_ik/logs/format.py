"""Conventions of a log: topics, schemas as ros2msg text, log times, and the record of its origin.

The text of a schema is all a reader needs to get the `Layout` back: each line carries the type and
the name and, behind "#", the shape if it has more than one axis, the unit and the doc.
"""

from __future__ import annotations

import json
import os
import platform
import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from mcap.records import Metadata
from numpy.typing import NDArray

from casadi_ik.compile.layout import Field, Layout
from casadi_ik.errors import InputError, LogError
from casadi_ik.files.writing import to_json
from casadi_ik.logs.container import ForeignLogError, check_size

MESSAGE_KINDS = ("iteration", "solve", "event")
"""The kinds of messages, each on a topic of its own per method."""

ITERATION_PERIOD = 1_000_000
"""Log time between two iterations: 1 ms [ns]."""

_ROS_TYPES = {"f8": "float64", "f4": "float32", "u4": "uint32", "i4": "int32", "u1": "uint8"}
_ROS_NAME = re.compile(r"(?!.*__)(?!.*_\Z)[a-z][a-z0-9_]*\Z")
_CONSTANT = re.compile(r"[a-z]+[0-9]*\s+[A-Z][A-Z0-9_]*\s*=")
_LINE = re.compile(r"(?P<type>[a-z]+[0-9]*)(?P<array>\[\d{1,9}\])?\s+(?P<name>[a-z]\w*)\Z")
_COMMENT = re.compile(
    r"(?:\((?P<shape>\d{1,9}(?:, \d{1,9}){0,7})\) )?\[(?P<unit>[^\]]*)\](?: (?P<doc>.*))?\Z"
)


@dataclass(frozen=True)
class LogClock:
    """Log times are computed, not measured, so that a solve is a known range of time.

    The default is the same in every log, so that the logs of several workers share one time; true
    times are publish times.

    Attributes:
        t0: Log time of solve 0, iteration 0 [ns since the Unix epoch]: the year 2000 begins.
        slot: Log time between two solves, room for 60,000 iterations [ns].

    Example:
        >>> ik.logs.LogClock(t0=0).slot > 0
        True
    """

    t0: int = 946_684_800_000_000_000
    slot: int = 60_000_000_000

    def start(self, solve_id: int) -> int:
        """Log time of a solve's first iteration [ns]."""
        return self.t0 + solve_id * self.slot

    @property
    def room(self) -> int:
        """Iterations of a solve that there is time for."""
        return self.slot // ITERATION_PERIOD

    def check(self, first: int, count: int) -> None:
        """Check that there is time for so many solves from `first` on.

        Raises:
            LogError: A solve's number is negative or beyond what 64-bit nanoseconds can tell.
        """
        last = first + count - 1
        if not (first >= 0 and last < 2**32 and self.start(last + 1) < 2**63):
            wrong = first if first < 0 else last
            raise LogError(f"solve {wrong}: the log has no time for a solve of this number")

    def times(self, solve_id: NDArray[np.int64], iteration: NDArray[np.int64]) -> np.ndarray:
        """Log times of iterations, uint64 [ns]; both arguments of the same shape."""
        return (self.t0 + solve_id * self.slot + iteration * ITERATION_PERIOD).astype(np.uint64)

    def locate(self, log_times: np.ndarray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Solve and iteration of log times: the inverse of `times`, two int64 arrays."""
        since = log_times.astype(np.int64) - self.t0
        solve_id = since // self.slot
        return solve_id, (since - solve_id * self.slot) // ITERATION_PERIOD


def topic(method: str, kind: str) -> str:
    """Topic of a method's messages; kind is one of `MESSAGE_KINDS`."""
    return f"/ik/{method}/{kind}"


def schema_name(kind: str, method: str, layout: Layout, fingers: int) -> str:
    """Schema name of a method's messages: the kind, the method and the robot's shape.

    Q is the number of coordinates, F of fingers, J of singular values that are logged:
    "casadi_ik/msg/IterationEnhancedDlsQ14F3J4".

    Args:
        kind: One of `MESSAGE_KINDS`.
        method: Name of the method.
        layout: Of its iterations.
        fingers: Number of fingers.
    """
    words = "".join(word[:1].upper() + word[1:] for word in re.findall(r"[A-Za-z0-9]+", method))
    coordinates = next((item.size for item in layout if item.name == "q"), 0)
    jacobians = sum(item.size for item in layout if item.name.startswith("sigma_"))
    return f"casadi_ik/msg/{kind.capitalize()}{words}Q{coordinates}F{fingers}J{jacobians}"


def schema_text(layout: Layout, labels: Mapping[str, tuple[str, ...]] | None = None) -> str:
    """The ros2msg text of a record layout.

    Args:
        layout: Fields by falling width, as `Layout.record` sorts them.
        labels: Names of the codes of integer scalars become constants right before the field,
            where viewers take them for its enum names.

    Raises:
        LogError: The layout cannot be a message: a field would need padding, is empty, or has a
            name that ROS forbids.
    """
    _check_widths(layout, f"layout of {layout.names}")
    lines: list[str] = []
    for item in layout:
        if not _ROS_NAME.match(item.name):
            raise LogError(f"field {item.name!r}: a ROS field name is lower_snake_case")
        if item.size == 0 or "]" in item.unit:
            raise LogError(f"field {item.name!r}: shape {item.shape}, unit {item.unit!r}")
        ros_type = _ROS_TYPES[item.dtype]
        if item.shape == () and item.dtype[0] in "ui" and not item.name.endswith("_mask"):
            for code, name in enumerate((labels or {}).get(item.name, ())):
                words = re.findall(r"[A-Z0-9]+", f"{item.name} {name}".upper())
                lines += [f"{ros_type} {'_'.join(words)}={code}"] if name else []
        length = f"[{item.size}]" if item.shape else ""
        shape = f"({', '.join(map(str, item.shape))}) " if len(item.shape) > 1 else ""
        comment = f"{shape}[{item.unit}] {' '.join(item.doc.split())}".rstrip()
        lines.append(f"{ros_type}{length} {item.name} # {comment}")
    return "\n".join(lines) + "\n"


def parse_layout(text: str) -> Layout:
    """The layout that `schema_text` was given.

    Raises:
        LogError: Not such a text.
    """
    lines = (line.partition("#") for line in text.splitlines())
    coded = ((code.strip(), comment.strip()) for code, _, comment in lines)
    wanted = [each for each in coded if each[0] and not _CONSTANT.match(each[0])]
    try:
        layout = Layout(tuple(_field(*each) for each in wanted))
    except InputError as error:
        raise LogError(f"schema: {error}") from error
    _check_widths(layout, "schema: its layout")
    size = sum(item.size * np.dtype(item.dtype).itemsize for item in layout)
    check_size("schema: a message", size)
    return layout


def _check_widths(layout: Layout, what: str) -> None:
    widths = [np.dtype(item.dtype).itemsize for item in layout]
    if not widths or widths != sorted(widths, reverse=True):
        raise LogError(f"{what} is not sorted by falling width, or empty")


def _field(code: str, comment: str) -> Field:
    """The field that a line of a schema describes."""
    line, about = _LINE.match(code), _COMMENT.match(comment)
    storage = {ros: dtype for dtype, ros in _ROS_TYPES.items()}
    if line is None or line["type"] not in storage or about is None:
        raise LogError(f"schema: the line {code[:60]!r} is no part of a record layout")
    shape = (int(line["array"][1:-1]),) if line["array"] else ()
    size = shape[0] if shape else 1
    if about["shape"]:
        shape = tuple(int(number) for number in about["shape"].split(", "))
    found = Field(line["name"], shape, storage[line["type"]], about["unit"], about["doc"] or "")
    if found.size != size:
        raise LogError(f"schema: field {found.name!r}: its shape has not {size} elements")
    return found


# Where a log comes from: the metadata record, written by a recorder and checked by a reader.

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
    iteration_ns: Number = str(ITERATION_PERIOD)
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
    return with_checksum(
        {
            "format": FORMAT,
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "robot": robot_name,
            "seed": str(seed),
            "keep": json.dumps(keep),
            "t0_ns": str(clock.t0),
            "slot_ns": str(clock.slot),
            "iteration_ns": str(ITERATION_PERIOD),
            "compression": compression,
            "code_version": _version("casadi-ik"),
            "packages": json.dumps(package_versions(PACKAGES)),
            "python": platform.python_version(),
            "machine": json.dumps(machine()),
            "parameters": json.dumps(to_json(parameters)),
        }
    )


def with_checksum(record: Mapping[str, str]) -> dict[str, str]:
    """The entries with their checksum."""
    entries = sorted((key, text) for key, text in record.items() if key != CHECKSUM)
    return {**record, CHECKSUM: f"{zlib.crc32(json.dumps(entries).encode()):08x}"}


def machine() -> dict[str, Any]:
    """The computer: system, processor, cores."""
    return {"system": platform.platform(), "processor": _processor(), "cores": os.cpu_count()}


def package_versions(names: Iterable[str]) -> dict[str, str]:
    """Versions of installed packages by name."""
    return {name: _version(name) for name in names}


def casadi_ik_record(records: Sequence[Metadata]) -> Mapping[str, str]:
    """Our record among those of a file.

    Raises:
        ForeignLogError: There is none.
        LogError: There are several, it fails its checksum, or it is of an unknown version.
    """
    found = [record.metadata for record in records if record.name == METADATA_NAME]
    if len(found) != 1:
        names = ", ".join(sorted({repr(record.name)[1:-1] for record in records})) or "none"
        problem = f"metadata {METADATA_NAME!r} twice" if found else f"no metadata {METADATA_NAME!r}"
        kind = LogError if found else ForeignLogError
        raise kind(f"not a log of casadi_ik: {problem} (found: {names})")
    (record,) = found
    if record != with_checksum(record):
        raise LogError("the log is damaged: its metadata fail their checksum")
    if record.get("format") != FORMAT:
        raise LogError(f"format: found {record.get('format', '')[:20]!r}, expected {FORMAT!r}")
    return record


def parse_metadata(record: Mapping[str, str]) -> Mapping[str, Any]:
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
    if found.iteration_ns != str(ITERATION_PERIOD):
        raise LogError(
            f"metadata: iteration_ns: found {found.iteration_ns}, expected {ITERATION_PERIOD}"
        )
    return {**msgspec.structs.asdict(found), **values}


def clock_from_metadata(values: Mapping[str, Any]) -> LogClock:
    """The rule of a log's times.

    Raises:
        LogError: It leaves no time for an iteration.
    """
    t0, slot = int(values["t0_ns"]), int(values["slot_ns"])
    if not (t0 < 2**63 and ITERATION_PERIOD <= slot < 2**63):
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
