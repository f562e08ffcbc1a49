"""What can be said behind a command: how words are read, and every option that several have.

An option that one command alone has is declared with that command.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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
            "GRASP", "[SOLVE]" (may be left out), "[LOG...]".
        help: What it means, without its default.
        read: Makes the value of a word, or of all words where there may be several; None: the
            word or words as they are.
        default: The value if it is not said.
        otherwise: The default in words, if its value does not say it.
        needed: Whether an option has to be said.
        repeated: Whether it may be said again, for more.
        key: What holds the value, if it is not called as the option or the argument.
    """

    said: str
    help: str
    read: Callable[[Any], Any] | None = None
    default: Any = None
    otherwise: str = ""
    needed: bool = False
    repeated: bool = False
    key: str = ""

    @property
    def name(self) -> str:
        """The option with its dashes; of an argument without dashes its key."""
        key = self.key or self.metavar.lower()
        return self.said.partition(" ")[0] if self.dashed else key

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
    def count(self) -> str | int | None:
        """How many words there are, as argparse's ``nargs``."""
        if "..." in self.value:
            return "*" if self.value.startswith("[") else "+"
        if self.value.startswith("["):
            return "?"
        return self.value.count(" ") + 1 if " " in self.value else None

    @property
    def text(self) -> str:
        """The help, its default included."""
        default = self.otherwise
        if not default and isinstance(self.default, (int, float, str)):
            default = str(self.default)
        return f"{self.help} (default: {default})" if default else self.help

    def of(self, words: Any) -> Any:
        """The value of the word, or words, that were said.

        Raises:
            ValueError: They are none; the message says what was found and what was expected.
        """
        if self.read is not None:
            return self.read(words)
        choices = self.metavar.split("|")
        if self.dashed and len(choices) > 1 and words not in choices:
            raise ValueError(f"found {words!r}, expected one of {', '.join(choices)}")
        return words


def needed(option: Option, **changes: Any) -> Option:
    """The option of a command that cannot do without it."""
    return replace(option, needed=True, default=None, otherwise="", **changes)


def out(metavar: str, text: str, read: Callable[[str], Any] | None = None) -> Option:
    """A needed ``--out``; names must end in the metavar's suffix, unless `read` is given."""
    return Option(f"--out {metavar}", text, read or file_name(Path(metavar).suffix), needed=True)


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


def numbers(words: Sequence[str]) -> list[float]:
    """Finite numbers, separated by commas or spaces."""
    return [number(word) for word in " ".join(words).replace(",", " ").split()]


def vector(count: int, meaning: str) -> Callable[[Sequence[str]], list[float]]:
    """So many numbers, as `numbers`."""

    def read(words: Sequence[str]) -> list[float]:
        values = numbers(words)
        if len(values) != count:
            raise ValueError(f"found {len(values)} numbers, expected {count}: {meaning}")
        return values

    return read


def positive(word: str) -> float:
    """A positive finite number."""
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise ValueError(f"found {word!r}, expected a number > 0")
    return value


def whole(least: int, most: int = 2**63 - 1) -> Callable[[str], int]:
    """A whole number; what 64 bits hold, unless said."""
    expected = f">= {least}" if most >= 2**63 - 1 else f"from {least} to {most}"

    def read(word: str) -> int:
        try:
            value = int(word)
        except ValueError:
            value = least - 1
        if not least <= value <= most:
            raise ValueError(f"found {word!r}, expected a whole number {expected}")
        return value

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
        if any(suffixes) and path.suffix.lower() not in suffixes:
            raise ValueError(f"found {word!r}, expected a name ending in {', '.join(suffixes)}")
        return path

    return read


def npz_or_folder(word: str) -> Path:
    """An npz file to be written, or a folder: one that is there, or a name without suffix."""
    path = file_name()(word)
    if path.suffix.lower() not in ("", ".npz") and not path.is_dir():
        raise ValueError(f"found {word!r}, expected OUT.npz or a folder without suffix")
    return path


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


# What several commands take.

POSE = vector(6, "x y z [m] roll pitch yaw [rad]")

GRASP = Option("GRASP", "a shipped name (`casadi-ik grasps`) or a YAML file")
ROBOT = Option("--robot R", "a shipped name or a YAML file", otherwise="what the file read says")
METHOD = Option("--method M", "one of `casadi-ik methods`", otherwise="the first of them")
Q0 = Option(
    "--q0 V...",
    "where the robot is: a number per actuator [rad or m], spaces or commas between; last "
    "on the line",
    numbers,
    otherwise="home",
)
PREFER = Option(
    "--prefer limits|manipulability|q0|clearance",
    "which of several solutions comes first: far from its limits, with a manipulable arm, near the "
    "start, or with --scene far from what may be hit",
    otherwise="q0 if it is given, else limits",
)
SCENE = Option(
    "--scene FILE",
    "what must not be touched: a shipped name or a YAML file",
    otherwise="collisions are not checked",
)
OBJECT_POSE = Option(
    "--object-pose X...",
    "where the object is: x y z [m] roll pitch yaw [rad] in the base frame; contacts move "
    "with it, and those of a file that does not say where its object is are in its frame",
    POSE,
)
SEED = Option("--seed N", "of all random numbers", whole(0), default=0)
TOLERANCES = (
    Option(
        "--tolerance-position METRES",
        "when a contact point counts as reached",
        positive,
        otherwise="0.005",
    ),
    Option(
        "--tolerance-angle RADIANS",
        "when a contact normal counts as reached",
        positive,
        otherwise="0.0524, 3 deg",
    ),
)
MAX_ROUNDS = Option(
    "--max-rounds N",
    "rounds of hand postures at most before a target is given up; 1 solves nearly all that "
    "can be reached",
    whole(1),
    otherwise="as many as may help",
)
LIMITS = Option(
    "--limits enforce|ignore",
    "whether being solved includes the limits; ignore: the paper's way",
    default="enforce",
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
        "answer much faster",
        otherwise="ipopt",
    ),
    Option(
        "--fixed NAME=V...",
        "actuators that are not to move, and where they stand [rad or m]",
        each(assignment),
        default=(),
        repeated=True,
    ),
    Option(
        "--log FILE.mcap",
        "write every iteration to a log; a batch in parts: into a folder, read as one log",
        file_name(),
    ),
)
"""Of `solve` and `batch`."""

SIZE_LIMITS = Option(
    "--size-limits FACTOR",
    "allow files that are so many times as large as usual, packed and unpacked",
    positive,
)
"""Of commands that read what is somebody else's."""


def diagnose(default: bool) -> Option:
    """Whether failures are explained; ``--no-diagnose`` says no."""
    text = "find out why what is not solved is not"
    return Option("--diagnose", text, default=default, otherwise="yes" if default else "no")


def picture(name: str, text: str) -> Option:
    """A picture to be written."""
    suffix = ".gif" if name == "--animation" else ".png"
    return Option(f"{name} FILE{suffix}", f"{text} (needs casadi-ik[plots])", file_name(suffix))
