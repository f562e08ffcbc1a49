"""What can be said behind a command: how words are read, and every option that several have.

An option that one command alone has is declared with that command.
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
"""What the command is called."""


@dataclass(frozen=True)
class Option:
    """An option, or an argument without dashes.

    Attributes:
        said: How it is said, in the way of usage lines: "--seed N", "--q0 V..." (one or more
            words), "--limits enforce|ignore" (one of these), "--pads" (yes, if it is said),
            "--[no-]deg" (yes or no), "GRASP", "[SOLVE]" (may be left out), "[LOG...]".
        help: What it means; without its default, unless `default` does not tell it.
        default: The value if it is not said.
        read: Makes the value of a word, or of all words where there may be several; None: what
            `KINDS` has for what stands for the value, else the word or words as they are.
        needed: Whether an option has to be said.
        repeated: Whether it may be said again, for more.
        key: What holds the value, if it is not called as the option or the argument.
    """

    said: str
    help: str
    default: Any = None
    read: Callable[[Any], Any] | None = None
    needed: bool = False
    repeated: bool = False
    key: str = ""

    @property
    def name(self) -> str:
        """The option with its dashes; of an argument without dashes its key."""
        if not self.dashed:
            return self.key or self.metavar.lower()
        return self.said.partition(" ")[0].replace("[no-]", "")

    @property
    def attribute(self) -> str:
        """The attribute of what was said that holds the value."""
        return self.key or self.name.lstrip("-").replace("-", "_")

    @property
    def dashed(self) -> bool:
        """Whether it begins with dashes."""
        return self.said.startswith("-")

    @property
    def value(self) -> str:
        """What stands for its value or values; "" for a flag."""
        return self.said.partition(" ")[2] if self.dashed else self.said

    @property
    def metavar(self) -> str:
        """What stands for one word of its value."""
        return self.value.strip("[].")

    @property
    def choices(self) -> list[str]:
        """The words that an option takes, if they are some and no others."""
        return self.metavar.split("|") if self.dashed and "|" in self.metavar else []

    @property
    def count(self) -> str | int | None:
        """How many words there are, as argparse's ``nargs``."""
        if "..." in self.value:
            return "*" if self.value.startswith("[") else "+"
        if self.value.startswith("["):
            return "?"
        return self.value.count(" ") + 1 if " " in self.value else None

    @property
    def unit(self) -> str:
        """Of its numbers: "m", "rad", "pose" (both), "motor" (of each motor its own), or ""."""
        return KINDS[self.value][1] if self.dashed and self.value in KINDS else ""

    @property
    def text(self) -> str:
        """The help, its default included."""
        given = isinstance(self.default, (int, float, str)) and self.default is not False
        plain = given and "(default:" not in self.help
        return f"{self.help} (default: {self.default})" if plain else self.help

    def of(self, words: Any) -> Any:
        """The value of the word, or words, that were said.

        Raises:
            ValueError: They are none; the message says what was found and what was expected.
        """
        read = self.read
        if read is None and self.choices:
            read = one_of(*self.choices)
        elif read is None and self.dashed and self.value in KINDS:
            read = KINDS[self.value][0]
        return words if read is None else read(words)


# How words become values; a ValueError says what was found and what was expected.


def number(word: str) -> float:
    """A finite number."""
    try:
        value = float(word)
    except ValueError:
        raise ValueError(f"found {word!r}, expected a number") from None
    if not math.isfinite(value):
        raise ValueError(f"found {word!r}, expected a finite number")
    return value


def numbers(words: Sequence[str], count: int = 0, meaning: str = "") -> list[float]:
    """Finite numbers, separated by commas or spaces; any count of them unless one is given."""
    values = [number(word) for word in " ".join(words).replace(",", " ").split()]
    if count and len(values) != count:
        raise ValueError(f"found {len(values)} numbers, expected {count}: {meaning}")
    return values


def positive(word: str) -> float:
    """A positive finite number."""
    with contextlib.suppress(ValueError):
        if (value := number(word)) > 0:
            return value
    raise ValueError(f"found {word!r}, expected a number > 0")


def whole(least: int, most: int = 2**63 - 1) -> Callable[[str], int]:
    """A whole number; what 64 bits hold, unless said."""

    def read(word: str) -> int:
        with contextlib.suppress(ValueError):
            if least <= int(word) <= most:
                return int(word)
        expected = f">= {least}" if most == 2**63 - 1 else f"from {least} to {most}"
        raise ValueError(f"found {word!r}, expected a whole number {expected}")

    return read


def one_of(*names: str) -> Callable[[str], str]:
    """One of some words."""

    def read(word: str) -> str:
        if word not in names:
            raise ValueError(f"found {word!r}, expected one of {', '.join(names)}")
        return word

    return read


def file_name(*suffixes: str) -> Callable[[str], Path]:
    """A file to be written, with one of the suffixes if any are given."""

    def read(word: str) -> Path:
        if not word:
            raise ValueError("found '', expected the name of a file")
        path = Path(word)
        if suffixes and path.suffix.lower() not in suffixes:
            raise ValueError(f"found {word!r}, expected a name ending in {', '.join(suffixes)}")
        return path

    return read


def json_name(word: str) -> Path:
    """A JSON file to be written; one without suffix is one, too."""
    return file_name(".json")(word) if Path(word).suffix else file_name()(word)


def assignment(word: str) -> tuple[str, float]:
    """A name and its number, ``NAME=V``."""
    name, _, value = word.partition("=")
    with contextlib.suppress(ValueError):
        if name:
            return name, number(value)
    raise ValueError(f"found {word!r}, expected NAME=NUMBER")


def each(read: Callable[[str], Any]) -> Callable[[Sequence[str]], list[Any]]:
    """Reads several words, each for itself."""
    return lambda words: [read(word) for word in words]


KINDS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "N": (whole(1), ""),
    "SECONDS": (positive, ""),
    "METRES": (positive, "m"),
    "RADIANS": (positive, "rad"),
    "FACTOR": (positive, ""),
    "V...": (numbers, "motor"),
    "NAME=V...": (each(assignment), "motor"),
    "POSE...": (partial(numbers, count=6, meaning="x y z [m] roll pitch yaw [rad]"), "pose"),
}
"""How the value of an option is read, and its `Option.unit`, by what stands for it."""

IN_UNITS = (
    Option(
        "--[no-]deg",
        "angles said here and in the report are in degrees (--no-deg: in radians; default: said in "
        "radians, reported in degrees)",
    ),
    Option(
        "--[no-]mm",
        "lengths said here and in the report are in mm (--no-mm: in m; default: said in m, "
        "reported in mm)",
    ),
)
"""Of every command that takes lengths or angles; what files hold is in m and rad."""


# What several commands take.

GRASP = Option("GRASP", "a shipped name (`casadi-ik grasps`) or a YAML file")
ROBOT = Option(
    "--robot R",
    "a shipped name (`casadi-ik robots`) or a YAML file (default: what the file read says)",
)
THE_ROBOT = Option("--robot R", "a shipped name (`casadi-ik robots`) or a YAML file", needed=True)
METHOD = Option("--method M", "one of `casadi-ik methods` (default: the first of them)")
Q0 = Option(
    "--q0 V...",
    "where the robot is: a number per actuator [rad or m], spaces or commas between; last "
    "on the line (default: home)",
)
PREFER = Option(
    "--prefer limits|manipulability|q0|clearance",
    "which of several solutions comes first: far from its limits, with a manipulable arm, near the "
    "start, or with --scene far from what may be hit (default: q0 if it is given, else limits)",
)
SCENE = Option(
    "--scene FILE",
    "what must not be touched: a shipped name (`casadi-ik scenes`) or a YAML file (default: "
    "collisions are not checked)",
)
OBJECT_POSE = Option(
    "--object-pose POSE...",
    "where the object is: x y z [m] roll pitch yaw [rad] in the base frame; contacts move "
    "with it, and those of a file that does not say where its object is are in its frame",
)
SEED = Option("--seed N", "of all random numbers", 0, whole(0))
TOLERANCES = (
    Option(
        "--tolerance-position METRES",
        "when a contact point counts as reached (default: 0.005, 5 mm)",
    ),
    Option(
        "--tolerance-angle RADIANS",
        "when a contact normal counts as reached (default: 0.0524, 3 deg)",
    ),
)
MAX_ROUNDS = Option(
    "--max-rounds N",
    "rounds of hand postures at most before a target is given up; 1 solves nearly all that "
    "can be reached (default: as many as may help)",
)
LIMITS = Option(
    "--limits enforce|ignore",
    "whether being solved includes the limits; ignore: the paper's way",
    "enforce",
)
SOLVER = (
    METHOD,
    Q0,
    PREFER,
    SCENE,
    OBJECT_POSE,
    SEED,
    *TOLERANCES,
    MAX_ROUNDS,
    LIMITS,
    Option(
        "--finger-step ipopt|closed-form",
        "solver of the fingers' own step in the paper's methods; closed-form gives the same "
        "answer much faster (default: ipopt)",
    ),
    Option(
        "--fixed NAME=V...",
        "actuators that are not to move, and where they stand [rad or m]",
        (),
        repeated=True,
    ),
    Option(
        "--log FILE.mcap",
        "write every iteration to a log; a batch in parts: into a folder, read as one log",
        read=file_name(),
    ),
)
"""Of `solve` and `batch`."""

SIZE_LIMITS = Option(
    "--size-limits FACTOR",
    "allow files that are so many times as large as usual, packed and unpacked",
)
"""Of commands that read what is somebody else's."""


def out(metavar: str, text: str, read: Callable[[str], Any] | None = None) -> Option:
    """A needed ``--out``; names must end in the metavar's suffix, unless `read` is given."""
    read = read or file_name(*filter(None, [Path(metavar).suffix]))
    return Option(f"--out {metavar}", text, read=read, needed=True)


def diagnose(default: bool) -> Option:
    """Whether failures are explained; ``--no-diagnose`` says no."""
    usual = "yes" if default else "no"
    text = f"find out why what is not solved is not (default: {usual})"
    return Option("--[no-]diagnose", text, default)


def picture(name: str, text: str) -> Option:
    """A picture to be written."""
    suffix = ".gif" if name == "--animation" else ".png"
    help_of = f"{text} (needs 'casadi-ik[plots]')"
    return Option(f"{name} FILE{suffix}", help_of, read=file_name(suffix))
