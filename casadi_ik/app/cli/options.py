"""Command-line options: their declaration, the parsers of their values, and shared options.

An option that only one command has is declared with that command.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

PROGRAM = "casadi-ik"
"""Name of the program."""


@dataclass(frozen=True)
class Option:
    """A named option or a positional argument of a command.

    Attributes:
        syntax: Usage: "--seed N", "--q0 V..." (one or more words), "--limits enforce|ignore"
            (choices), "--pads" (flag), "--[no-]deg" (flag with its negation), "GRASP" (positional),
            "[SOLVE]" (optional), "[LOG...]" (any number).
        help: Meaning; the default is appended unless the text states it.
        default: Value of an option that is not given.
        parse: Parser of the word, or of the list of words if several are allowed. None: the parser
            of the metavar in `VALUE_SYNTAXES`, or the words unchanged.
        required: Whether the option is mandatory.
        repeated: Whether the option may be repeated; the values are concatenated.
        key: Attribute of the value, if it differs from the name of the option.
    """

    syntax: str
    help: str
    default: Any = None
    parse: Callable[[Any], Any] | None = None
    required: bool = False
    repeated: bool = False
    key: str = ""

    @property
    def name(self) -> str:
        """Name with its dashes; the key of a positional argument."""
        if not self.is_named:
            return self.key or self.metavar.lower()
        return self.syntax.partition(" ")[0].replace("[no-]", "")

    @property
    def attribute(self) -> str:
        """Attribute of `Arguments` that holds the value."""
        return self.key or self.name.lstrip("-").replace("-", "_")

    @property
    def is_named(self) -> bool:
        """True for an option with dashes, False for a positional argument."""
        return self.syntax.startswith("-")

    @property
    def value_syntax(self) -> str:
        """Syntax of the value without the name; "" for a flag."""
        return self.syntax.partition(" ")[2] if self.is_named else self.syntax

    @property
    def metavar(self) -> str:
        """Placeholder of one word of the value; "" for a flag."""
        return self.value_syntax.strip("[].")

    @property
    def choices(self) -> list[str]:
        """Allowed words; empty if any word is allowed."""
        return self.metavar.split("|") if self.is_named and "|" in self.metavar else []

    @property
    def nargs(self) -> str | int | None:
        """Number of words, as ``nargs`` of argparse."""
        if "..." in self.value_syntax:
            return "*" if self.value_syntax.startswith("[") else "+"
        if self.value_syntax.startswith("["):
            return "?"
        return self.value_syntax.count(" ") + 1 if " " in self.value_syntax else None

    @property
    def unit(self) -> str:
        """Unit of the numbers: "m", "rad", "pose" (both), "motor" (depends on the motor), or ""."""
        is_typed = self.is_named and self.value_syntax in VALUE_SYNTAXES
        return VALUE_SYNTAXES[self.value_syntax][1] if is_typed else ""

    @property
    def help_text(self) -> str:
        """Help with the default value."""
        has_default = isinstance(self.default, (int, float, str)) and self.default is not False
        append = has_default and "(default:" not in self.help
        return f"{self.help} (default: {self.default})" if append else self.help

    def value_of(self, words: Any) -> Any:
        """Parse the word or words of the value.

        Raises:
            ValueError: The value is invalid; the message states it and the expected value.
        """
        parse = self.parse
        if parse is None and self.choices:
            parse = choice(*self.choices)
        elif parse is None and self.is_named and self.value_syntax in VALUE_SYNTAXES:
            parse = VALUE_SYNTAXES[self.value_syntax][0]
        return words if parse is None else parse(words)


# Parsers of values. Each raises a ValueError with the value found and the value expected.


def number(word: str) -> float:
    """Parse a finite number."""
    try:
        value = float(word)
    except ValueError:
        raise ValueError(f"found {word!r}, expected a number") from None
    if not math.isfinite(value):
        raise ValueError(f"found {word!r}, expected a finite number")
    return value


def numbers(words: Sequence[str], count: int = 0, meaning: str = "") -> list[float]:
    """Parse finite numbers separated by commas or spaces; `count` of them unless it is 0."""
    values = [number(word) for word in " ".join(words).replace(",", " ").split()]
    if count and len(values) != count:
        raise ValueError(f"found {len(values)} numbers, expected {count}: {meaning}")
    return values


def positive(word: str) -> float:
    """Parse a positive finite number."""
    with contextlib.suppress(ValueError):
        if (value := number(word)) > 0:
            return value
    raise ValueError(f"found {word!r}, expected a number > 0")


def integer(lower: int, upper: int = 2**63 - 1) -> Callable[[str], int]:
    """Return a parser of integers within bounds."""

    def parse(word: str) -> int:
        with contextlib.suppress(ValueError):
            if lower <= int(word) <= upper:
                return int(word)
        expected = f">= {lower}" if upper == 2**63 - 1 else f"from {lower} to {upper}"
        raise ValueError(f"found {word!r}, expected an integer {expected}")

    return parse


def choice(*names: str) -> Callable[[str], str]:
    """Return a parser that accepts only the given names."""

    def parse(word: str) -> str:
        if word not in names:
            raise ValueError(f"found {word!r}, expected one of {', '.join(names)}")
        return word

    return parse


def file_name(*suffixes: str) -> Callable[[str], Path]:
    """Return a parser of output files with one of the suffixes, or with any if none is given."""

    def parse(word: str) -> Path:
        if not word:
            raise ValueError("found '', expected the name of a file")
        path = Path(word)
        if suffixes and path.suffix.lower() not in suffixes:
            raise ValueError(f"found {word!r}, expected a name ending in {', '.join(suffixes)}")
        return path

    return parse


def json_name(word: str) -> Path:
    """Parse the name of a JSON output file; the suffix may be absent."""
    return file_name(".json")(word) if Path(word).suffix else file_name()(word)


def assignment(word: str) -> tuple[str, float]:
    """Parse a name and its number, ``NAME=V``."""
    name, _, value = word.partition("=")
    with contextlib.suppress(ValueError):
        if name:
            return name, number(value)
    raise ValueError(f"found {word!r}, expected NAME=NUMBER")


def word_list(parse: Callable[[str], Any]) -> Callable[[Sequence[str]], list[Any]]:
    """Return a parser that applies `parse` to every word."""
    return lambda words: [parse(word) for word in words]


VALUE_SYNTAXES: dict[str, tuple[Callable[[Any], Any], str]] = {
    "N": (integer(1), ""),
    "SECONDS": (positive, ""),
    "METRES": (positive, "m"),
    "RADIANS": (positive, "rad"),
    "FACTOR": (positive, ""),
    "V...": (numbers, "motor"),
    "NAME=V...": (word_list(assignment), "motor"),
    "POSE...": (partial(numbers, count=6, meaning="x y z [m] roll pitch yaw [rad]"), "pose"),
}
"""Parser and `Option.unit` by the syntax of the value."""

UNIT_OPTIONS = (
    Option("--[no-]deg", "use degrees (default: options in radians, report in degrees)"),
    Option("--[no-]mm", "use millimetres (default: options in m, report in mm)"),
)
"""Options of every command that takes lengths or angles. Files always hold m and rad."""


# Options that several commands share.

GRASP = Option("GRASP", "name listed by `casadi-ik grasps`, or YAML file")
ROBOT = Option(
    "--robot R",
    "robot name or YAML file (default: the robot of the input)",
)
REQUIRED_ROBOT = Option(
    "--robot R", "name listed by `casadi-ik robots`, or YAML file", required=True
)
METHOD = Option("--method M", "name listed by `casadi-ik methods` (default: the first)")
Q0 = Option(
    "--q0 V...",
    "start positions of the actuators [rad or m] (default: home)",
)
PREFER = Option(
    "--prefer limits|manipulability|q0|clearance",
    "preferred solution (default: q0 if present, else limits)",
)
SCENE_FILE = Option(
    "--scene FILE",
    "scene name or YAML file of obstacles (default: none)",
)
OBJECT_POSE = Option(
    "--object-pose POSE...", "object in the base frame: x y z [m] roll pitch yaw [rad]"
)
RANDOM_SEED = Option("--seed N", "seed of all random numbers", 0, integer(0))
TOLERANCES = (
    Option(
        "--tolerance-position METRES",
        "position tolerance of contacts (default: 0.005, 5 mm)",
    ),
    Option(
        "--tolerance-angle RADIANS",
        "angle tolerance of contacts (default: 0.0524, 3 deg)",
    ),
)
MAX_RESTARTS = Option(
    "--max-rounds N",
    "maximum number of restarts per target (default: adaptive)",
)
LIMIT_MODE = Option("--limits enforce|ignore", "joint limits; ignore: as in the paper", "enforce")
SOLVER = (
    METHOD,
    Q0,
    PREFER,
    SCENE_FILE,
    OBJECT_POSE,
    RANDOM_SEED,
    *TOLERANCES,
    MAX_RESTARTS,
    LIMIT_MODE,
    Option(
        "--finger-step ipopt|closed-form",
        "finger solver of the papers' methods (default: ipopt)",
    ),
    Option(
        "--fixed NAME=V...",
        "actuators held fixed, with their positions [rad or m]",
        (),
        repeated=True,
    ),
    Option(
        "--log FILE.mcap",
        "log of every iteration; a folder for a batch in parts",
        parse=file_name(),
    ),
)
"""Options of `solve` and `batch`."""

SIZE_LIMITS = Option(
    "--size-limits FACTOR",
    "factor on input-size limits, compressed and uncompressed",
)
"""Option of every command that reads untrusted files."""


def out_option(metavar: str, text: str, parse: Callable[[str], Any] | None = None) -> Option:
    """Return a required option ``--out``.

    Args:
        metavar: Placeholder of the file; its suffix is mandatory unless `parse` is given.
        text: Help.
        parse: Parser of the name.
    """
    parse = parse or file_name(*filter(None, [Path(metavar).suffix]))
    return Option(f"--out {metavar}", text, parse=parse, required=True)


def diagnose(default: bool) -> Option:
    """Return the option ``--[no-]diagnose``."""
    default_text = "yes" if default else "no"
    return Option(
        "--[no-]diagnose", f"diagnose unsolved targets (default: {default_text})", default
    )


MESHES = Option("--[no-]meshes", "draw visual meshes of robots (default: yes)", True)
BEST_EFFORT = Option("--best-effort", "nearest configuration of unsolved targets")


def picture(name: str, text: str) -> Option:
    """Return an option for a picture (PNG) or animation (GIF) to be written."""
    suffix = ".gif" if name == "--animation" else ".png"
    help_text = f"{text} (needs 'casadi-ik[plots]')"
    return Option(f"{name} FILE{suffix}", help_text, parse=file_name(suffix))
