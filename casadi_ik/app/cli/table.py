"""Table of commands, from which parser, help and reference documentation are generated.

To add a command, write its function with its options in a module of this package::

    @command(GRASP, ROBOT, Option("--colour C", "colour of the drawing", "red"))
    def paint(args: Arguments) -> CommandResult:
        \"\"\"Paint a grasp.

        Examples, file formats and exit codes, printed by `--help` below the options.
        \"\"\"
        return CommandResult(f"{args.grasp} in {args.colour}")

and add a row to `COMMANDS`. The module is imported when the command is called. Each value is
parsed by `parse` of its option; a `ValueError` becomes one line on stderr that starts with the
name of the option. Lengths and angles reach the function in m and rad, with or without `--mm` and
`--deg`; motor positions are converted once the robot is known.
"""

from __future__ import annotations

import argparse
import inspect
import math
import re
import textwrap
from argparse import Namespace as Arguments
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from importlib import import_module
from typing import TYPE_CHECKING, Any, NoReturn

from casadi_ik.app.cli.options import PROGRAM, UNIT_OPTIONS, Option
from casadi_ik.errors import InputError, did_you_mean

if TYPE_CHECKING:
    from rich.console import RenderableType

COMMANDS = {
    "solve": ("solve.solve", "solve one grasp"),
    "batch": ("batch.batch", "solve many targets of one robot"),
    "follow": ("motion.follow", "follow a moving hand, or moving contacts"),
    "reach": ("motion.reach", "plan a timed motion to a grasp"),
    "place-base": ("planning.place_base", "find the base that reaches most of the palm poses"),
    "map": ("planning.reach_map", "map the palm poses that an arm can reach"),
    "grasp": ("planning.grasp", "find feasible grasps of an object's mesh"),
    "choose": ("solve.choose", "rank candidate grasps of an object"),
    "import": ("own_robot.import_robot", "describe a robot by its URDF or MJCF files"),
    "export": ("own_robot.export", "write a robot's solver as plain C or WebAssembly"),
    "compile": ("own_robot.compile_ahead", "compile the kernels of robots ahead of use"),
    "schemas": ("lists.schemas", "write JSON Schemas of robot, grasp and other files"),
    "calibrate": ("own_robot.calibrate", "estimate a hand's dimensions from measured poses"),
    "robots": ("lists.robots", "list the shipped robots: fingers and actuators"),
    "methods": ("lists.methods", "list the methods"),
    "grasps": ("lists.grasps", "list the shipped grasps"),
    "objects": ("lists.objects", "list the shipped objects"),
    "scenes": ("lists.scenes", "list the shipped scenes"),
    "log": ("", "inspect logs"),
    "log info": ("log.info", "summarise the contents of logs"),
    "log solves": ("log.solves", "list solves with their status"),
    "log events": ("log.events", "list events: singularities, limits, stalls, ..."),
    "log why": ("log.explain_solve", "explain one solve in words"),
    "log plot": ("log.plot", "plot the convergence of one solve"),
    "log compare": ("log.compare", "compare two methods on the same targets"),
    "log report": ("log.report", "write a study as an HTML page"),
    "log export": ("log.export", "write tables, or a file for a viewer"),
    "log finish": ("log.finish", "repair, in place, logs whose writer was killed"),
    "log merge": ("log.merge", "merge the shards of a study without recompression"),
    "view": ("view.view", "open the interactive viewer, or play a log"),
    "meshes": ("lists.meshes", "list or fetch visual meshes of robots"),
    "completion": ("lists.completion", "print TAB completion for bash, zsh or fish"),
}
"""Subcommand -> ("module.function" in this package, one-line summary)."""

GROUPS = {
    "": """\
Inverse kinematics for robot arms with multi-fingered hands: motor positions that
bring the fingertips to given contacts, or a diagnosis if there are none.

Examples:
  casadi-ik grasps                      list the shipped grasps
  casadi-ik solve cup                   solve a shipped grasp
  casadi-ik solve my.yaml --log my.mcap solve your grasp with a log
  casadi-ik log info my.mcap            summarise the log

Lengths are in m and angles in rad, in files and in options. With --mm and
--deg, options and reports use mm and degrees.

exit codes: 0 solved (or done), 1 a valid problem not solved, 2 bad input
""",
    "log": """\
Inspect logs that `--log` has written.

Examples:
  casadi-ik log info cup.mcap                        summary
  casadi-ik log solves study/ --status STALLED       stalled solves
  casadi-ik log events cup.mcap --event NEAR_SINGULAR
  casadi-ik log why cup.mcap 3                       solve 3 in words
  casadi-ik log plot cup.mcap 3 --out 3.png
  casadi-ik log compare ours.mcap paper.mcap         two methods
  casadi-ik log report study/ --out report.html      study as a page
  casadi-ik log export cup.mcap --solve 3 --out view.mcap      for Foxglove
  casadi-ik log export study/ --what solves --out solves.parquet
  casadi-ik log finish cut.mcap                      repair a truncated log
  casadi-ik log merge a.mcap b.mcap --out all.mcap

A folder means all logs in it.
""",
}
"""Help of the program ("") and of commands with subcommands."""

WIDTH = 78
"""Line width of help texts [columns]."""


class Exit(IntEnum):
    """Exit codes of the program, in addition to those of signals (130 Ctrl-C, 143 SIGTERM)."""

    DONE = 0
    """Success; for `solve` and `batch`: every target is solved."""
    NOT_SOLVED = 1
    """The problem is valid but not solved; the report states the reason."""
    BAD_INPUT = 2
    """The input is invalid; a line on stderr states the location and the expected value."""
    BROKEN_PIPE = 141
    """The reader of stdout closed it (128 + SIGPIPE)."""


@dataclass(frozen=True)
class CommandResult:
    """Report and exit code of a command that has written its files.

    Attributes:
        report: Report for stdout; a string is printed unchanged.
        exit: Exit code.
        epilogue: Function that is called after the report is printed; None: none.
    """

    report: RenderableType
    exit: Exit = Exit.DONE
    epilogue: Callable[[], None] | None = None

    @staticmethod
    def of_parts(success: bool, *report: RenderableType) -> CommandResult:
        """Return the result of a command that succeeds or fails, from the parts of its report."""
        from rich.console import Group

        return CommandResult(Group(*report), Exit.DONE if success else Exit.NOT_SOLVED)


@dataclass(frozen=True)
class Command:
    """A command of the table.

    Attributes:
        run: Function that executes the command.
        options: Options and positional arguments.
    """

    run: Callable[[Arguments], CommandResult]
    options: tuple[Option, ...]

    @property
    def doc_parts(self) -> tuple[str, str, str]:
        """First paragraph of the docstring, the separator, and the remaining text."""
        return (inspect.getdoc(self.run) or "").partition("\n\n")


def command(*options: Option) -> Callable[[Callable[[Arguments], CommandResult]], Command]:
    """Return a decorator that converts a function of arguments to a command."""
    unit_options = UNIT_OPTIONS if any(option.unit for option in options) else ()
    return lambda run: Command(run, options + unit_options)


def load(name: str) -> Command:
    """Import the module of a command and return the command."""
    module, function = COMMANDS[name][0].split(".")
    return getattr(import_module(f"casadi_ik.app.cli.{module}"), function)


def command_names(group: str = "") -> list[str]:
    """Return the commands of a group; "" is the group of top-level commands."""
    return [name for name in COMMANDS if name.rpartition(" ")[0] == group]


def parse(words: Sequence[str]) -> tuple[Callable[[Arguments], CommandResult], Arguments]:
    """Return the function of the command line, and the arguments to call it with.

    Raises:
        InputError: A command or option is unknown, or a value is invalid.
    """
    if list(words) == ["--version"]:
        return lambda _: _version(), Arguments()
    name, remaining = "", list(words)
    while name in GROUPS:
        if not remaining or remaining[0] in ("-h", "--help"):
            break
        name, remaining = _resolve_command(name, remaining[0]), remaining[1:]
    if name in GROUPS or {"-h", "--help"}.intersection(remaining):
        return lambda _: CommandResult(command_help(name)), Arguments()
    loaded = load(name)
    return loaded.run, _Parser(name, loaded).parse_values(remaining)


def command_help(name: str) -> str:
    """Return the help of a command, of a group of commands, or of the program ("")."""
    if name not in GROUPS:
        return _Parser(name, load(name)).format_help()
    summary, _, details = GROUPS[name].partition("\n\n")
    rows = {sub.removeprefix(name).strip(): COMMANDS[sub][1] for sub in command_names(name)}
    width = max(map(len, rows)) + 2
    listing = "\n".join(f"  {sub:<{width}}{text}" for sub, text in rows.items())
    words = " ".join(filter(None, (PROGRAM, name, "COMMAND")))
    hint = f"run `{words} --help` for details"
    return f"usage: {words} ...\n\n{_wrap(summary)}\n\ncommands: ({hint})\n{listing}\n\n{details}"


def usage(name: str, loaded: Command) -> str:
    """Return the usage line with the required arguments of a command."""
    words = [item.syntax for item in loaded.options if item.required or not item.is_named]
    optional = ["[OPTIONS]"] if any(item.is_named for item in loaded.options) else []
    line = " ".join([PROGRAM, name, *words, *optional])
    return textwrap.fill(
        line, WIDTH - len("usage: "), subsequent_indent="  ", break_on_hyphens=False
    )


def _wrap(text: str) -> str:
    """Wrap paragraphs to the width of help; keep those with an indented line unchanged."""
    paragraphs = []
    for paragraph in text.split("\n\n"):
        is_prose = not any(line.startswith(" ") for line in paragraph.splitlines())
        wrapped = textwrap.fill(paragraph, WIDTH, break_on_hyphens=False)
        paragraphs.append(wrapped if is_prose else paragraph)
    return "\n\n".join(paragraphs)


def _resolve_command(group: str, word: str) -> str:
    """Return the full name of a command of a group.

    Raises:
        InputError: The group has no such command.
    """
    by_word = {name.rpartition(" ")[2]: name for name in command_names(group)}
    if word in by_word:
        return by_word[word]
    program = f"{PROGRAM} {group}".strip()
    raise InputError(
        f"COMMAND: found {word!r}, {did_you_mean(word, by_word)} (see {program} --help)"
    )


def _version() -> CommandResult:
    from importlib.metadata import version

    return CommandResult(f"{PROGRAM} {version('casadi-ik')}\n")


class _Parser(argparse.ArgumentParser):
    """Parser of one command whose errors are reported as one line."""

    def __init__(self, name: str, loaded: Command) -> None:
        description, _, details = loaded.doc_parts
        super().__init__(
            prog=f"{PROGRAM} {name}",
            usage=usage(name, loaded),
            description=_wrap(description),
            epilog=_wrap(details),
            formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, width=WIDTH),
            allow_abbrev=False,
        )
        # argparse would read `-1e-3,0.2` in `--q0 -1e-3,0.2` as an option.
        self._negative_number_matcher = re.compile(r"-(\d|\.\d|inf|nan)", re.IGNORECASE)
        self._options = loaded.options
        for option in loaded.options:
            self.add_argument(option.name, **_argparse_settings(option))

    def parse_values(self, words: Sequence[str]) -> Arguments:
        """Return the values of all options, with lengths and angles in m and rad.

        Raises:
            InputError: A word is unexpected, a required option is missing, or a value is invalid.
        """
        args, unknown = self.parse_known_args(words)
        if unknown:
            self.error(self._unknown_word(unknown[0]))
        for option in self._options:
            raw = getattr(args, option.attribute)
            if raw is None or raw == []:
                setattr(args, option.attribute, option.default)
            elif option.metavar:
                try:
                    value = option.value_of(raw)
                except ValueError as error:
                    self.error(f"{option.name if option.is_named else option.metavar}: {error}")
                setattr(args, option.attribute, _value_to_si(value, option.unit, args))
        return args

    def _unknown_word(self, word: str) -> str:
        """Return the error message for a word that the command does not take."""
        if word.startswith("-"):
            names = [option.name for option in self._options if option.is_named]
            return f"{word}: option is unknown, {did_you_mean(word, names, 'see the help')}"
        positional = " ".join(item.metavar for item in self._options if not item.is_named)
        return f"unexpected argument {word!r} after {positional or self.prog}"

    def error(self, message: str) -> NoReturn:
        """Reject the command line.

        Raises:
            InputError: Always.
        """
        raise InputError(f"{message.removeprefix('argument ')} (see {self.prog} --help)")


def _argparse_settings(option: Option) -> dict[str, Any]:
    """Return arguments of `add_argument`; values and defaults are set by `parse_values`."""
    settings: dict[str, Any] = {"help": option.help_text.replace("%", "%%")}
    if not option.metavar:
        action = argparse.BooleanOptionalAction if "[no-]" in option.syntax else "store_true"
        return settings | {"action": action, "dest": option.attribute, "default": None}
    has_fixed_count = isinstance(option.nargs, int)
    settings["metavar"] = tuple(option.metavar.split()) if has_fixed_count else option.metavar
    settings["nargs"] = option.nargs
    if option.is_named:
        settings |= {"required": option.required, "dest": option.attribute}
    return settings | ({"action": "extend"} if option.repeated else {})


def to_si(value: float, unit: str, args: Arguments) -> float:
    """Convert a number of the command line to m or rad, as `--mm` and `--deg` require."""
    if unit == "m":
        return 1e-3 * value if args.mm else value
    return math.radians(value) if unit == "rad" and args.deg else value


def _value_to_si(value: Any, unit: str, args: Arguments) -> Any:
    """Convert the value of an option; motor positions are converted once the robot is known."""
    if unit == "pose":
        return [to_si(x, "m" if i < 3 else "rad", args) for i, x in enumerate(value)]
    return to_si(value, unit, args)
