"""The program in a shell: lists, help, exit codes, signals."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import FAST, Command, Run
from commands import COMMANDS, GROUPS, load
from processes import POSIX

import casadi_ik as ik

PROGRAM = [sys.executable, "-m", "casadi_ik"]
ROBOT = "kuka_lwr_barrett"


def test_robots(run: Command, robot: ik.ArmHand) -> None:
    done = run("robots").fine()
    words = done.out.replace(",", " ").split()
    for name in (robot.name, *robot.fingers, *robot.actuators, "Kermani"):
        assert name in words
    # How an arm is solved: an S-R-S arm, a swept one, one of three parallel axes, one nearly of a
    # form, and one whose last axis passes by its wrist.
    for word in ("shoulder", "swept", "parallel", "nearly", "off"):
        assert word in words


@pytest.mark.parametrize(
    ("command", "names"),
    [
        ("methods", ik.METHODS),
        ("grasps", (*ik.shipped_names("grasps"), ROBOT, "baxter_ar10")),
        ("objects", ik.shipped_names("objects")),
        ("scenes", ik.shipped_names("scenes")),
    ],
)
def test_lists(command: str, names: tuple[str, ...], run: Command) -> None:
    done = run(command).fine()
    assert not set(names).difference(done.out.split())
    assert done.out.count("(default)") == (command == "methods")


def commands(run: Command, group: str = "") -> Iterator[str]:
    """Yield the commands that the help names, with their subcommands."""
    text = run(*group.split(), "--help").out
    for line in text.partition("\ncommands:")[2].partition("\n\n")[0].splitlines()[1:]:
        name = f"{group} {line.split()[0]}".strip()
        yield name
        yield from commands(run, name)


def test_help(run: Command) -> None:
    """Help fits a terminal of 80 columns, and is also printed without arguments."""
    names = ["", *commands(run)]
    assert {"solve", "batch", "view", "log", "log info", "log merge"} < set(names)
    for command in names:
        done = run(*command.split(), "--help").fine()
        assert done.out.startswith(f"usage: casadi-ik {command}".rstrip())
        assert max(map(len, done.out.splitlines())) <= 80
        if "\ncommands:" in done.out:
            assert run(*command.split()) == done
    assert run("--version").out == f"casadi-ik {version('casadi-ik')}\n"


@pytest.mark.parametrize("name", sorted(COMMANDS.keys() - GROUPS.keys()))
def test_help_texts_are_short(name: str) -> None:
    """Help texts have at most 60 characters, including the default."""
    for option in load(name).options:
        assert len(option.help_text) <= 60, option.name


def test_layouts_of_candidates_are_listed(run: Command) -> None:
    words = re.findall(r"\w+", run("choose", "--help").fine().out)
    assert {"dexgraspnet", "multidex", "isaac_grasp", "acronym", "table"} <= set(words)


def test_misspelt_options_are_suggested(run: Command) -> None:
    assert "'--tolerance-position'" in run("solve", "cup", "--tolerence-position", "1").error


AS_A_MODULE = "import runpy; runpy.run_module('casadi_ik', run_name='__main__', alter_sys=True)"


def test_help_loads_neither_casadi_nor_rich() -> None:
    code = "import atexit, sys; atexit.register(lambda: print(*sys.modules)); " + AS_A_MODULE
    words = [sys.executable, "-c", code, "--help"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert not {"casadi", "numpy", "rich"}.intersection(done.stdout.split())


COMPLETIONS = {
    "sol": {"solve"},
    "log ev": {"events"},
    "solve cu": {"cup"},
    "solve cup --tol": {"--tolerance-position", "--tolerance-angle"},
    "solve cup --scene ta": {"table"},
    "batch x --limits en": {"enforce"},
    "log plot a.mcap --r": {"--range"},
    "export ku": {"kuka_lwr_barrett", "kuka_lwr_barrett_coupled"},
}


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_words_are_completed(tmp_path: Path) -> None:
    script = [f'source <("{sys.executable}" -m casadi_ik completion bash)']
    for words in COMPLETIONS:
        script.append(f"COMP_WORDS=(casadi-ik {words}) COMP_CWORD={len(words.split())}")
        script.append('_casadi_ik; echo "${COMPREPLY[@]}"')
    done = subprocess.run(
        ["bash", "-c", "\n".join(script)], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert [set(line.split()) for line in done.stdout.splitlines()] == list(COMPLETIONS.values())
    assert done.stderr == ""


def test_completion_of_every_command(run: Command) -> None:
    for shell, start in (("bash", "_casadi_ik()"), ("zsh", "autoload"), ("fish", "complete -c")):
        done = run("completion", shell).fine()
        assert done.out.startswith(start)
        for command in commands(run):
            assert command.rpartition(" ")[2] in done.out


def test_exit_codes(
    run_process: Command, grasp_file: Callable[..., Path], far_away: Path, tmp_path: Path
) -> None:
    assert run_process("solve", grasp_file(), *FAST).exit == 0
    assert run_process("solve", far_away, *FAST).exit == 1
    assert run_process("solve", tmp_path / "nothing.yaml").error.endswith("no such file")


def test_console_script() -> None:
    script = Path(sys.executable).with_name("casadi-ik")
    done = subprocess.run([script, "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("casadi-ik ")


@POSIX
def test_reader_goes_away() -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [*PROGRAM, "grasps"], stdout=writing, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(writing)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_stdout_is_full() -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*PROGRAM, "grasps"], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    error = Run(done.returncode, "", done.stderr).error
    assert error == "<stdout>: cannot be written: No space left on device"


def test_poor_terminal(run_process: Command) -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "COLUMNS": "40"}
    done = run_process("grasps", env=environment).fine()
    assert done.out.isascii()


@POSIX
def test_ctrl_c_while_modules_are_imported() -> None:
    """A module that imports CasADi sends the signal, so that no timing is involved."""
    code = """if True:
    import os, signal, sys
    class Finder:
        def find_spec(self, name, *_):
            if name == "casadi":
                os.kill(os.getpid(), signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.meta_path.insert(0, Finder())
"""
    words = [sys.executable, "-c", code + AS_A_MODULE, "grasps"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "casadi-ik: error: interrupted\n"


@pytest.mark.slow
@POSIX
@pytest.mark.parametrize(
    ("jobs", "finished", "signals"),
    [
        (1, False, [signal.SIGINT]),
        (1, True, [signal.SIGINT] * 50),
        (2, False, [signal.SIGTERM]),
        (2, True, [signal.SIGINT]),
        (1, True, [signal.SIGTERM, signal.SIGTERM]),
    ],
)
def test_interrupted(
    tmp_path: Path, jobs: int, finished: bool, signals: list[signal.Signals]
) -> None:
    """In the middle of a long batch: the exit code of the signal, and what is finished stays.

    Nothing here depends on how fast the machine is, or how busy: not how many rows are finished,
    nor whether all of these are solved. Pressed again and again, Ctrl-C may cost what is just being
    written, and may come while that is cleaned up: then hidden files stay for a later batch.
    """
    robot = ik.load_robot(ROBOT)
    points, normals = robot.contacts(robot.random(np.random.default_rng(0), 30_000))
    targets, out = tmp_path / "targets.npz", tmp_path / "out.npz"
    np.savez(targets, points=points, normals=normals)
    process = start_batch(targets, out, "--method", "ipopt", "--jobs", str(jobs))
    assert wait_for(tmp_path, finished)
    for signal_number in signals:
        process.send_signal(signal_number)
        time.sleep(0.01)
    output, error = process.communicate(timeout=600)  # the batch would take longer
    interrupted = signals[0] == signal.SIGINT
    ended = "interrupted" if interrupted else "terminated"
    assert process.returncode == (130 if interrupted else 143), error
    lines = error.splitlines()
    assert (output, lines[-1]) == ("", f"casadi-ik: error: {ended}")
    is_repeated = len(signals) > 2
    left = {path for path in tmp_path.iterdir() if not (is_repeated and path.name.startswith("."))}
    assert left == ({targets, out} if out.exists() else {targets})
    if not out.exists():
        assert is_repeated or not finished
        return
    with np.load(out) as answers:
        count = len(answers["q"])
        assert 0 < count < 30_000
        assert {len(answers[name]) for name in answers.files} == {count}
        solved, (points_reached, _) = answers["success"], robot.contacts(answers["q"])
    assert solved.any()
    np.testing.assert_allclose(points_reached[solved], points[:count][solved], atol=5e-3)
    output = f"casadi-ik: interrupted: {out} keeps the first {count} of 30000 rows"
    assert is_repeated or output in lines


def start_batch(targets: Path, out: Path, *options: str) -> subprocess.Popen[str]:
    """Start a batch that takes minutes."""
    return subprocess.Popen(
        [*PROGRAM, "batch", targets, "--robot", ROBOT, "--out", out, *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


def wait_for(folder: Path, finished: bool) -> bool:
    """Return whether a batch has started its output, or written rows, within ten minutes."""
    # On a busy machine the first use may compile for minutes.
    deadline = time.monotonic() + 600
    while time.monotonic() < deadline:
        begun = list(folder.glob(".batch-*/q" if finished else ".batch-*"))
        if begun and (not finished or begun[0].stat().st_size):  # rows that are counted, too
            return True
        time.sleep(0.05)
    return False


@pytest.mark.slow
@POSIX
def test_a_killed_batch(run: Command, tmp_path: Path) -> None:
    """A killed batch leaves no result; a later one removes its old files."""
    robot = ik.load_robot(ROBOT)
    points, normals = robot.contacts(robot.random(np.random.default_rng(0), 300))
    targets, out = tmp_path / "targets.npz", tmp_path / "out.npz"
    np.savez(targets, points=points, normals=normals)
    process = start_batch(targets, out, "--method", "ipopt")
    assert wait_for(tmp_path, finished=False)
    process.kill()
    process.communicate()
    assert not out.exists()
    (left,) = tmp_path.glob(".batch-*")
    young = tmp_path / f".batch-{os.getpid()}-running"
    young.mkdir()
    np.savez(targets, points=points[:2], normals=normals[:2])
    repeat_words = ("batch", targets, "--robot", robot.name, "--out", out)
    assert run(*repeat_words).exit == 0
    assert left.exists()  # a process elsewhere could be at it
    then = time.time() - 3700
    for path in (*left.iterdir(), left, young):
        os.utime(path, (then, then))
    assert run(*repeat_words).exit == 0
    assert sorted(tmp_path.iterdir()) == sorted([young, out, targets])


def test_bugs_are_not_hidden(run: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ik.Solver, "solve", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run("solve", "cup")


def test_warnings_are_one_line(run: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    solve = ik.Solver.solve

    def warn(*arguments: Any, **options: Any) -> ik.Solution:
        with warnings.catch_warnings():
            warnings.simplefilter("once")
            warnings.warn("no C compiler:\n slower", UserWarning, stacklevel=1)
        return solve(*arguments, **options)

    monkeypatch.setattr(ik.Solver, "solve", warn)
    done = run("solve", "cup")
    assert done.exit == 0
    assert set(done.err.splitlines()) == {"casadi-ik: warning: no C compiler: slower"}
