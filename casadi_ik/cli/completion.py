"""`casadi-ik completion`: a script by which a shell completes words, from the table of commands."""

from __future__ import annotations

from casadi_ik.cli.options import PROGRAM, Option, one_of
from casadi_ik.cli.table import COMMANDS, GROUPS, Answer, Said, command, load, names
from casadi_ik.files.shipped import shipped_names
from casadi_ik.registry import METHODS

SHIPPED = {
    "GRASP": ("grasps",),
    "GRASP|ROBOT|LOG|CHOICES": ("grasps", "arm_hands"),
    "--robot": ("arm_hands",),
    "ROBOT": ("arm_hands",),
    "--scene": ("scenes",),
    "--object": ("objects",),
}
"""Kinds of shipped names that a value may be, by the option or by what stands for the value."""

BASH = """\
_casadi_ik() {{
    local word=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}} place= known=
    ((COMP_CWORD > 1)) && place=${{COMP_WORDS[1]}}
    [[ $place == log ]] && ((COMP_CWORD > 2)) && place="log ${{COMP_WORDS[2]}}"
    case "$place:$before" in
{cases}
    esac
    COMPREPLY=($(compgen -f -W "$known" -- "$word"))
}}
complete -o filenames -F _casadi_ik {program}
"""


@command(Option("SHELL", "which shell", read=one_of("bash", "zsh", "fish")))
def completion(said: Said) -> Answer:
    """Print a script by which a shell completes commands, options and shipped names with TAB.

    Examples:
      eval "$(casadi-ik completion bash)"      in ~/.bashrc
      eval "$(casadi-ik completion zsh)"       in ~/.zshrc, behind compinit
      casadi-ik completion fish > ~/.config/fish/completions/casadi-ik.fish

    exit codes: 0 printed, 2 bad input
    """
    return Answer({"bash": _bash, "zsh": _zsh, "fish": _fish}[said.shell]())


def _words(option: Option) -> list[str]:
    """What an option or an argument may be, as far as that is known."""
    if option.name == "--method":
        return list(METHODS)
    kinds = SHIPPED.get(option.name) or SHIPPED.get(option.metavar, ())
    return option.choices + [name for kind in kinds for name in shipped_names(kind)]


def _bash() -> str:
    cases = []
    for group in GROUPS:
        known = [name.rpartition(" ")[2] for name in names(group)]
        cases.append(f'"{group}:"*) known="{" ".join(known)}" ;;')
    for name in COMMANDS:
        if name in GROUPS:
            continue
        options = load(name).options
        for option in options:
            if option.dashed and option.metavar:
                cases.append(f'"{name}:{option.name}") known="{" ".join(_words(option))}" ;;')
        known = [one.name for one in options if one.dashed]
        known += [word for one in options if not one.dashed for word in _words(one)]
        cases.append(f'"{name}:"*) known="{" ".join(known)}" ;;')
    return BASH.format(cases="\n".join(f"        {case}" for case in cases), program=PROGRAM)


def _zsh() -> str:
    return f"autoload -U +X bashcompinit && bashcompinit\n{_bash()}"


def _fish() -> str:
    lines = []
    for name, (_, summary) in COMMANDS.items():
        group, _, word = name.rpartition(" ")
        seen = "__fish_seen_subcommand_from"
        outer = f"{seen} {group}" if group else "__fish_use_subcommand"
        lines.append(f"-n '{outer}' -f -a {word} -d '{summary}'")
        if name in GROUPS:
            continue
        inner = f"{seen} {word}; and {'' if group else 'not '}{seen} log"
        for option in load(name).options:
            values = f" -a '{' '.join(_words(option))}'"
            text = option.help.partition(";")[0].partition(":")[0].replace("'", "")
            shown = f" -l {option.name[2:]}" + " -r" * bool(option.metavar) if option.dashed else ""
            lines.append(f"-n '{inner}'{shown}{values if option.metavar else ''} -d '{text}'")
    return "".join(f"complete -c {PROGRAM} {line}\n" for line in lines)
