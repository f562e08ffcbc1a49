"""The table of commands: parser, help and the page of the documentation are made from it.

To add a command, write its function with its options in a module of this folder, new or not::

    @command(GRASP, ROBOT, Option("--colour C", "what it is drawn in", "red"))
    def paint(said: Said) -> Answer:
        \"\"\"Paint a grasp.

        Examples, formats of files and exit codes: what `--help` says below the options.
        \"\"\"
        return Answer(f"{said.grasp} in {said.colour}")

and give it a row in `COMMANDS`. Its module is imported when it is called. Its value is read by the
option's `read`, errors of which become one line on stderr that begins with the option's name.
Lengths and angles come to the function in m and rad, whatever `--mm` and `--deg` say.
"""

from __future__ import annotations

import argparse
import inspect
import math
import re
import textwrap
from argparse import Namespace as Said
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from importlib import import_module
from typing import TYPE_CHECKING, Any, NoReturn

from casadi_ik.app.cli.options import IN_UNITS, PROGRAM, Option
from casadi_ik.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from rich.console import RenderableType

COMMANDS = {
    "solve": ("solve.solve", "solve one grasp"),
    "batch": ("batch.batch", "solve many targets of one robot"),
    "follow": ("motion.follow", "follow a moving hand, or moving contacts"),
    "reach": ("motion.reach", "find the timed motion from where the robot is to a grasp"),
    "grasp": ("grasp.grasp", "find grasps of an object's mesh that the robot can make"),
    "choose": ("solve.choose", "find the best of many grasps of one object"),
    "import": ("own_robot.import_robot", "describe your robot from its URDF or MJCF files"),
    "export": ("own_robot.export", "write a robot's solver as plain C or WebAssembly"),
    "compile": ("own_robot.compile_ahead", "compile robots' kernels ahead of use"),
    "schemas": ("lists.schemas", "write JSON Schemas of robot, grasp and other files"),
    "calibrate": ("own_robot.calibrate", "estimate a hand's dimensions from measured poses"),
    "robots": ("lists.robots", "list the shipped robots: fingers and actuators"),
    "methods": ("lists.methods", "list the methods"),
    "grasps": ("lists.grasps", "list the shipped grasps"),
    "objects": ("lists.objects", "list the shipped objects"),
    "scenes": ("lists.scenes", "list the shipped scenes"),
    "log": ("", "look into logs"),
    "log info": ("log.info", "what logs hold"),
    "log solves": ("log.solves", "list solves and how they ended"),
    "log events": ("log.events", "list events: singularities, limits, stalls, ..."),
    "log why": ("log.why", "explain one solve in words"),
    "log plot": ("log.plot", "draw how one solve went"),
    "log compare": ("log.compare", "compare two methods on the same targets"),
    "log report": ("log.report", "write a study as one page"),
    "log export": ("log.export", "write tables, or a file for a viewer"),
    "log finish": ("log.finish", "repair logs in place whose writer was killed"),
    "log merge": ("log.merge", "join the shards of a study, without recompressing"),
    "view": ("view.view", "drag contacts in the browser, arm and hand follow; play a log"),
    "completion": ("lists.completion", "complete words in bash, zsh or fish with TAB"),
}
"""What is said: module and function in this folder, and what it does, in a few words."""

GROUPS = {
    "": """\
Inverse kinematics for robot arms with multi-fingered hands: fingertip contacts in,
motor positions out, or the reason why not.

Examples:
  casadi-ik grasps                      list the shipped grasps
  casadi-ik solve cup                   solve one of them
  casadi-ik solve my.yaml --log my.mcap your own, with a log of every iteration
  casadi-ik log info my.mcap            what the log holds

Lengths are in m and angles in rad, in files and in options; behind --mm and
--deg those of options and reports are in mm and degrees.

exit codes: 0 solved (or done), 1 a valid problem not solved, 2 bad input
""",
    "log": """\
Look into logs that `--log` has written.

Examples:
  casadi-ik log info cup.mcap                        what it holds
  casadi-ik log solves study/ --status STALLED       those that stalled
  casadi-ik log events cup.mcap --event NEAR_SINGULAR
  casadi-ik log why cup.mcap 3                       solve 3 in words
  casadi-ik log plot cup.mcap 3 --out 3.png
  casadi-ik log compare ours.mcap paper.mcap         two methods
  casadi-ik log report study/ --out report.html      success, times, the hardest
  casadi-ik log export cup.mcap --solve 3 --out view.mcap      for Foxglove
  casadi-ik log export study/ --what solves --out solves.parquet
  casadi-ik log finish torn.mcap                     repair a torn log
  casadi-ik log merge a.mcap b.mcap --out all.mcap

A folder stands for all logs in it.
""",
}
"""What is said of the program, and of commands that have commands of their own."""

WIDTH = 78
"""Columns of help."""


class Exit(IntEnum):
    """Exit codes of the program, beside those of signals (130: Ctrl-C, 143: SIGTERM)."""

    DONE = 0
    """Done; for `solve` and `batch`: everything is solved."""
    NOT_SOLVED = 1
    """A valid problem that is not solved; the report says why."""
    BAD_INPUT = 2
    """One line on stderr says where, what was found and what was expected."""
    BROKEN_PIPE = 141
    """Whoever read the report went away (128 + SIGPIPE)."""


@dataclass(frozen=True)
class Answer:
    """The end of a command; by now all files are written.

    Attributes:
        report: What to show on stdout; a text is printed as it is.
        exit: The exit code.
        after: What is done once the report is shown; None: nothing.
    """

    report: RenderableType
    exit: Exit = Exit.DONE
    after: Callable[[], None] | None = None

    @staticmethod
    def solved(solved: bool, *report: RenderableType) -> Answer:
        """The end of a command that has something to solve, and the parts of its report."""
        from rich.console import Group

        return Answer(Group(*report), Exit.DONE if solved else Exit.NOT_SOLVED)


@dataclass(frozen=True)
class Command:
    """A command of the table.

    Attributes:
        run: Does it.
        options: What can be said behind it.
    """

    run: Callable[[Said], Answer]
    options: tuple[Option, ...]

    @property
    def text(self) -> tuple[str, str, str]:
        """What it does, and the rest of what is to be known: its function's docstring, parted."""
        return (inspect.getdoc(self.run) or "").partition("\n\n")


def command(*options: Option) -> Callable[[Callable[[Said], Answer]], Command]:
    """Make a command of a function that takes what was said."""
    in_units = IN_UNITS if any(option.unit for option in options) else ()
    return lambda run: Command(run, options + in_units)


def load(name: str) -> Command:
    """A command of the table, its module imported."""
    module, function = COMMANDS[name][0].split(".")
    return getattr(import_module(f"casadi_ik.app.cli.{module}"), function)


def names(group: str = "") -> list[str]:
    """The commands of a group, "": those behind the program's name."""
    return [name for name in COMMANDS if name.rpartition(" ")[0] == group]


def parse(words: Sequence[str]) -> tuple[Callable[[Said], Answer], Said]:
    """What to do, and what was said about it.

    Raises:
        InputError: No such command or option, or a value that is none.
    """
    if list(words) == ["--version"]:
        return lambda _: _version(), Said()
    name, rest = "", list(words)
    while name in GROUPS:
        if not rest or rest[0] in ("-h", "--help"):
            break
        name, rest = _next(name, rest[0]), rest[1:]
    if name in GROUPS or {"-h", "--help"}.intersection(rest):
        return lambda _: Answer(help_of(name)), Said()
    found = load(name)
    return found.run, _Parser(name, found).values(rest)


def help_of(name: str) -> str:
    """The help of a command, of a group of them, or of the program ("")."""
    if name not in GROUPS:
        return _Parser(name, load(name)).format_help()
    first, _, rest = GROUPS[name].partition("\n\n")
    rows = {one.removeprefix(name).strip(): COMMANDS[one][1] for one in names(name)}
    width = max(map(len, rows)) + 2
    listed = "\n".join(f"  {one:<{width}}{summary}" for one, summary in rows.items())
    words = " ".join(filter(None, (PROGRAM, name, "COMMAND ...")))
    more = "--help behind a command says what it takes"
    return f"usage: {words}\n\n{_filled(first)}\n\ncommands: ({more})\n{listed}\n\n{rest}"


def usage(name: str, what: Command) -> str:
    """How a command is called: what has to be said."""
    words = [one.said for one in what.options if one.needed or not one.dashed]
    more = ["[OPTIONS]"] if any(one.dashed for one in what.options) else []
    return " ".join([PROGRAM, name, *words, *more])


def _filled(text: str) -> str:
    """Prose to the width of help; a paragraph in which a line is indented stays as it is."""
    parts = []
    for part in text.split("\n\n"):
        plain = not any(line.startswith(" ") for line in part.splitlines())
        parts.append(textwrap.fill(part, WIDTH, break_on_hyphens=False) if plain else part)
    return "\n\n".join(parts)


def _next(group: str, word: str) -> str:
    """The command that a word means.

    Raises:
        InputError: None.
    """
    known = {one.rpartition(" ")[2]: one for one in names(group)}
    if word in known:
        return known[word]
    program = f"{PROGRAM} {group}".strip()
    raise InputError(f"COMMAND: found {word!r}, {did_you_mean(word, known)} (see {program} --help)")


def _version() -> Answer:
    from importlib.metadata import version

    return Answer(f"{PROGRAM} {version('casadi-ik')}\n")


class _Parser(argparse.ArgumentParser):
    """The parser of one command; its errors are one line like all others."""

    def __init__(self, name: str, what: Command) -> None:
        description, _, rest = what.text
        super().__init__(
            prog=f"{PROGRAM} {name}",
            usage=usage(name, what),
            description=_filled(description),
            epilog=_filled(rest),
            formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, width=WIDTH),
            allow_abbrev=False,
        )
        # So that `--q0 -1e-3,0.2` reads as numbers and not as an option.
        self._negative_number_matcher = re.compile(r"-(\d|\.\d|inf|nan)", re.IGNORECASE)
        self._options = what.options
        for option in what.options:
            self.add_argument(option.name, **_argument(option))

    def values(self, words: Sequence[str]) -> Said:
        """What was said, every option by its key, lengths and angles in m and rad.

        Raises:
            InputError: A word that has no place, one that is missing, or a value that is none.
        """
        said, rest = self.parse_known_args(words)
        if rest:
            self.error(self._unknown(rest[0]))
        for option in self._options:
            raw = getattr(said, option.attribute)
            if raw is None or raw == []:
                setattr(said, option.attribute, option.default)
            elif option.metavar:
                try:
                    value = option.of(raw)
                except ValueError as error:
                    self.error(f"{option.name if option.dashed else option.metavar}: {error}")
                setattr(said, option.attribute, _all_in_si(value, option.unit, said))
        return said

    def _unknown(self, word: str) -> str:
        if word.startswith("-"):
            names = [one.name for one in self._options if one.dashed]
            return f"{word}: no such option, {did_you_mean(word, names, 'none is like it')}"
        places = " ".join(one.metavar for one in self._options if not one.dashed)
        return f"found {word!r}, expected nothing behind {places or self.prog}"

    def error(self, message: str) -> NoReturn:
        """Refuse the command line.

        Raises:
            InputError: Always.
        """
        raise InputError(f"{message.removeprefix('argument ')} (see {self.prog} --help)")


def _argument(option: Option) -> dict[str, Any]:
    """An option as argparse takes it; values are read, and defaults put in, afterwards."""
    found: dict[str, Any] = {"help": option.text.replace("%", "%%")}
    if not option.metavar:
        switch = argparse.BooleanOptionalAction if "[no-]" in option.said else "store_true"
        return found | {"action": switch, "dest": option.attribute, "default": None}
    several = isinstance(option.count, int)
    found["metavar"] = tuple(option.metavar.split()) if several else option.metavar
    found["nargs"] = option.count
    if option.dashed:
        found |= {"required": option.needed, "dest": option.attribute}
    return found | ({"action": "extend"} if option.repeated else {})


def in_si(value: float, unit: str, said: Said) -> float:
    """A number that was said, in m or rad, whatever `--mm` and `--deg` say."""
    if unit == "m":
        return 1e-3 * value if said.mm else value
    return math.radians(value) if unit == "rad" and said.deg else value


def _all_in_si(value: Any, unit: str, said: Said) -> Any:
    """The value of an option likewise; that of motors, whose units are the robot's, as it is."""
    if unit == "pose":
        return [in_si(one, "m" if i < 3 else "rad", said) for i, one in enumerate(value)]
    return in_si(value, unit, said)
