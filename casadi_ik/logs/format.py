"""Conventions of a log: topics, schemas as ros2msg text, log times, and metadata.

A reader reconstructs the `Layout` from the text of a schema: each line holds type and name and,
after "#", the shape if it has more than one axis, the unit and the description.
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
from casadi_ik.files.renamed_modules import warn_renamed
from casadi_ik.files.writing import to_json
from casadi_ik.logs.chunks import check_size
from casadi_ik.logs.container import ForeignLogError

MESSAGE_KINDS = ("iteration", "solve", "event")
"""Kinds of messages; every method has one topic of each kind."""

ITERATION_PERIOD = 1_000_000
"""Log time between two iterations [ns]: 1 ms."""

_ROS_TYPES = {"f8": "float64", "f4": "float32", "u4": "uint32", "i4": "int32", "u1": "uint8"}
_ROS_NAME = re.compile(r"(?!.*__)(?!.*_\Z)[a-z][a-z0-9_]*\Z")
_CONSTANT = re.compile(r"[a-z]+[0-9]*\s+[A-Z][A-Z0-9_]*\s*=")
_LINE = re.compile(r"(?P<type>[a-z]+[0-9]*)(?P<array>\[\d{1,9}\])?\s+(?P<name>[a-z]\w*)\Z")
_COMMENT = re.compile(
    r"(?:\((?P<shape>\d{1,9}(?:, \d{1,9}){0,7})\) )?\[(?P<unit>[^\]]*)\](?: (?P<doc>.*))?\Z"
)


@dataclass(frozen=True)
class LogClock:
    """Rule of log times: a solve occupies a known range of computed times.

    The default is the same in every log, so that the logs of several workers share one timeline.
    Measured times are publish times.

    Attributes:
        t0: Log time of iteration 0 of solve 0 [ns since the Unix epoch]: start of the year 2000.
        slot: Log time between two solves, enough for 60,000 iterations [ns].

    Example:
        >>> ik.logs.LogClock(t0=0).slot > 0
        True
    """

    t0: int = 946_684_800_000_000_000
    slot: int = 60_000_000_000

    def start(self, solve_id: int) -> int:
        """Return the log time of a solve's first iteration [ns]."""
        return self.t0 + solve_id * self.slot

    @property
    def max_iterations(self) -> int:
        """Maximum number of iterations of a solve that have log times."""
        return self.slot // ITERATION_PERIOD

    @property
    def room(self) -> int:
        """Deprecated name of `max_iterations`."""
        warn_renamed("LogClock.room", "LogClock.max_iterations")
        return self.max_iterations

    def check(self, first: int, count: int) -> None:
        """Check that consecutive solves have log times.

        Args:
            first: Number of the first solve.
            count: Number of solves.

        Raises:
            LogError: A solve's number is negative, or its time exceeds 64-bit nanoseconds.
        """
        last = first + count - 1
        if not (first >= 0 and last < 2**32 and self.start(last + 1) < 2**63):
            number = first if first < 0 else last
            raise LogError(f"number {number} of the solve is outside of the range of log times")

    def times(self, solve_id: NDArray[np.int64], iteration: NDArray[np.int64]) -> np.ndarray:
        """Return log times, uint64 [ns], for solves and iterations of the same shape."""
        return (self.t0 + solve_id * self.slot + iteration * ITERATION_PERIOD).astype(np.uint64)

    def locate(self, log_times: np.ndarray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return solves and iterations of log times, two int64 arrays; the inverse of `times`."""
        elapsed = log_times.astype(np.int64) - self.t0
        solve_id = elapsed // self.slot
        return solve_id, (elapsed - solve_id * self.slot) // ITERATION_PERIOD


def topic(method: str, kind: str) -> str:
    """Return the topic of a method's messages of one of the `MESSAGE_KINDS`."""
    return f"/ik/{method}/{kind}"


def schema_name(kind: str, method: str, layout: Layout, fingers: int) -> str:
    """Return the schema name of a method's messages.

    The name consists of the kind, the method, and the numbers of actuators (Q), fingers (F) and
    logged singular values (J), e.g. "casadi_ik/msg/IterationEnhancedDlsQ14F3J4".

    Args:
        kind: One of `MESSAGE_KINDS`.
        method: Name of the method.
        layout: Layout of its iterations.
        fingers: Number of fingers.
    """
    words = "".join(word[:1].upper() + word[1:] for word in re.findall(r"[A-Za-z0-9]+", method))
    coordinates = next((item.size for item in layout if item.name == "q"), 0)
    jacobians = sum(item.size for item in layout if item.name.startswith("sigma_"))
    return f"casadi_ik/msg/{kind.capitalize()}{words}Q{coordinates}F{fingers}J{jacobians}"


def schema_text(layout: Layout, labels: Mapping[str, tuple[str, ...]] | None = None) -> str:
    """Return the ros2msg text of a record layout.

    Args:
        layout: Fields in order of decreasing width, as `Layout.record` sorts them.
        labels: Names of codes by field. Those of integer scalars become constants before the field,
            which viewers interpret as the names of an enumeration.

    Raises:
        LogError: The layout cannot be a message: a field needs padding, is empty, or has a name
            that ROS forbids.
    """
    _check_widths(layout, f"layout of {layout.names}")
    lines: list[str] = []
    for item in layout:
        if not _ROS_NAME.match(item.name):
            raise LogError(f"field {item.name!r}: name is not in lower_snake_case, as ROS expects")
        if item.size == 0 or "]" in item.unit:
            raise LogError(
                f"field {item.name!r}: found shape {item.shape} and unit {item.unit!r}; expected a"
                " non-empty shape and a unit without ']'"
            )
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
    """Return the layout of a text of `schema_text`.

    Raises:
        LogError: The text does not describe a record layout.
    """
    lines = (line.partition("#") for line in text.splitlines())
    pairs = ((code.strip(), comment.strip()) for code, _, comment in lines)
    definitions = [pair for pair in pairs if pair[0] and not _CONSTANT.match(pair[0])]
    try:
        layout = Layout(tuple(_parse_field(*pair) for pair in definitions))
    except InputError as error:
        raise LogError(f"schema: {error}") from error
    _check_widths(layout, "schema: its layout")
    size = sum(item.size * np.dtype(item.dtype).itemsize for item in layout)
    check_size("schema: a message", size)
    return layout


def _check_widths(layout: Layout, name: str) -> None:
    """Check that fields need no padding: their widths decrease.

    Raises:
        LogError: The layout is empty or not sorted by decreasing width.
    """
    widths = [np.dtype(item.dtype).itemsize for item in layout]
    if not widths or widths != sorted(widths, reverse=True):
        raise LogError(f"{name} is empty or not sorted by decreasing width")


def _parse_field(code: str, comment: str) -> Field:
    """Return the field that a line of a schema describes.

    Raises:
        LogError: The line does not describe a field.
    """
    line, details = _LINE.match(code), _COMMENT.match(comment)
    dtypes = {ros_type: dtype for dtype, ros_type in _ROS_TYPES.items()}
    if line is None or line["type"] not in dtypes or details is None:
        raise LogError(f"schema: line {code[:60]!r} is not a field of a record layout")
    shape = (int(line["array"][1:-1]),) if line["array"] else ()
    size = shape[0] if shape else 1
    if details["shape"]:
        shape = tuple(int(number) for number in details["shape"].split(", "))
    field = Field(line["name"], shape, dtypes[line["type"]], details["unit"], details["doc"] or "")
    if field.size != size:
        raise LogError(
            f"schema: field {field.name!r}: found a shape of {field.size} elements, expected {size}"
        )
    return field


# Metadata: written by a recorder and checked by a reader.

METADATA_NAME = "casadi_ik"
"""Name of the metadata record."""

FORMAT = "2"
"""Version of the conventions of topics, schemas and metadata."""

CHECKSUM = "crc32"
"""Key of the checksum of all other entries; MCAP has no checksum of metadata."""

SHARDS = "shards"
"""Key of the description of the shards of a merged log."""

PACKAGES = ("casadi", "numpy", "mcap", "proxsuite", "msgspec", "pyyaml")
"""Packages whose versions are logged."""

Number = Annotated[str, msgspec.Meta(pattern=r"^[0-9]{1,19}\Z")]
Text = Annotated[str, msgspec.Meta(max_length=10_000)]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=200)]


class _Record(msgspec.Struct):
    """Types of the metadata entries; other entries are text."""

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
    """Return the metadata record of a log: text by key, with structured values as JSON."""
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
    """Return the entries of a record with their checksum."""
    entries = sorted((key, text) for key, text in record.items() if key != CHECKSUM)
    return {**record, CHECKSUM: f"{zlib.crc32(json.dumps(entries).encode()):08x}"}


def machine() -> dict[str, Any]:
    """Return the system, processor and number of cores of this computer."""
    return {"system": platform.platform(), "processor": _processor(), "cores": os.cpu_count()}


def package_versions(names: Iterable[str]) -> dict[str, str]:
    """Return the versions of installed packages by name."""
    return {name: _version(name) for name in names}


def casadi_ik_record(records: Sequence[Metadata]) -> Mapping[str, str]:
    """Return the metadata record of this package among those of a file.

    Raises:
        ForeignLogError: The file has no such record.
        LogError: It has several, or the record fails its checksum or has an unknown version.
    """
    matching = [record.metadata for record in records if record.name == METADATA_NAME]
    if len(matching) != 1:
        names = ", ".join(sorted({repr(record.name)[1:-1] for record in records})) or "none"
        error_type = LogError if matching else ForeignLogError
        raise error_type(
            f"not a log of casadi_ik: expected metadata {METADATA_NAME!r} once, found {names}"
        )
    (record,) = matching
    if record != with_checksum(record):
        raise LogError("the log is damaged: its metadata do not match their checksum")
    if record.get("format") != FORMAT:
        raise LogError(f"format: found {record.get('format', '')[:20]!r}, expected {FORMAT!r}")
    return record


def parse_metadata(record: Mapping[str, str]) -> Mapping[str, Any]:
    """Return the entries of the metadata record, with structured values parsed.

    Raises:
        LogError: An entry is missing or has the wrong type.
    """
    values = {
        key: parse_json(f"metadata: {key}", text, dict[str, Any])
        if key in ("packages", "machine", "parameters", "keep")
        else text
        for key, text in record.items()
    }
    try:
        entries = msgspec.convert(values, _Record)
    except msgspec.ValidationError as error:
        text, _, key = str(error).partition(" - at `$.")
        raise LogError(f"metadata: {key.rstrip('`') or 'record'}: {text}") from error
    if entries.iteration_ns != str(ITERATION_PERIOD):
        raise LogError(
            f"metadata: iteration_ns: found {entries.iteration_ns}, expected {ITERATION_PERIOD}"
        )
    return {**msgspec.structs.asdict(entries), **values}


def clock_from_metadata(values: Mapping[str, Any]) -> LogClock:
    """Return the rule of a log's times.

    Raises:
        LogError: The slot is shorter than an iteration, or a value exceeds 64 bits.
    """
    t0, slot = int(values["t0_ns"]), int(values["slot_ns"])
    if not (t0 < 2**63 and ITERATION_PERIOD <= slot < 2**63):
        raise LogError(
            f"metadata: found t0_ns {t0} and slot_ns {slot}; expected t0_ns < 2**63 and slot_ns"
            f" from {ITERATION_PERIOD} to 2**63"
        )
    return LogClock(t0, slot)


def parse_json(name: str, text: str, kind: Any) -> Any:
    """Parse JSON from a log.

    Args:
        name: Name of the value in error messages.
        text: JSON text.
        kind: Expected type.

    Raises:
        LogError: The text is not JSON of this type, or is nested too deeply.
    """
    depth_problem = f"{name}: lists and mappings are nested more than 32 deep"
    try:
        value = json.loads(text)
        if not _is_shallow(value, 32):
            raise LogError(depth_problem)
        return msgspec.convert(value, kind)
    except RecursionError as error:
        raise LogError(depth_problem) from error
    except msgspec.ValidationError as error:
        raise LogError(f"{name}: {error}") from error
    except ValueError as error:
        raise LogError(f"{name}: not JSON: {error}") from error


def _is_shallow(value: Any, max_depth: int) -> bool:
    """Return True if lists and mappings are nested at most `max_depth` deep."""
    if isinstance(value, dict | list):
        items = value.values() if isinstance(value, dict) else value
        return max_depth > 0 and all(_is_shallow(item, max_depth - 1) for item in items)
    return True


@cache
def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


@cache
def _processor() -> str:
    """Return the name of the processor from the kernel, or else from the platform module."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor())
