"""Every bad input: exit code 2, one line that says where, nothing written."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_line import Command

NAN, INF = float("nan"), float("inf")
METHOD = ("--method", "enhanced-dls")


# What follows the file's name; where a text ends, libyaml says at the start of the next line.
FILES: dict[str, tuple[bytes, str]] = {
    "broken YAML": (b"robot: [1,\n  a: b", r":(2:7|3:1): not valid YAML: .*expected ',' or '\]'"),
    "duplicate key": (b"robot: a\nrobot: b\n", ":2:1: not valid YAML: key 'robot' appears twice"),
    "empty": (b"", ": .*expected"),
    "binary": (bytes(range(256)), ": cannot be read: not UTF-8"),
    "zeros": (bytes(100), ": not valid YAML: unacceptable character"),
    "a list": (b"[1, 2]", ": .*expected"),
    "a number": (b"12", ": .*expected"),
    "code": (b"!!python/object/apply:os.system ['echo hi']", ":1:1: not valid YAML: could not"),
    "holds itself": (b"contacts: &a\n  thumb: *a\n", ": nested too deeply, or holds itself"),
    "no contacts": (b"robot: kuka_lwr_barrett", ": contacts: found none, expected"),
    "contacts empty": (b"robot: kuka_lwr_barrett\ncontacts: {}", ": contacts: found none"),
    "contacts a list": (b"contacts: [1, 2]", ": contacts: expected"),
}


@pytest.mark.parametrize("name", FILES)
def test_bad_grasp_file(name: str, refused: Callable[..., str], tmp_path: Path) -> None:
    content, says = FILES[name]
    path = tmp_path / "bad.yaml"
    path.write_bytes(content)
    error = refused("solve", path)
    assert re.match(re.escape(str(path)) + says, error), error


@pytest.mark.parametrize(
    ("key", "value", "fragment"),
    [
        ("normal", [0, 0, 0], "contacts.thumb.normal: found [0.0, 0.0, 0.0], expected"),
        ("normal", [0, NAN, 0], "contacts.thumb.normal: found [0.0, nan, 0.0], expected finite"),
        ("point", [NAN] * 3, "contacts.thumb.point: found [nan, nan, nan], expected finite"),
        ("point", [INF, 0, 0], "contacts.thumb.point: found [inf, 0.0, 0.0], expected finite"),
        ("point", [1, 2], "contacts.thumb.point: expected"),
        ("point", [1, 2, 3, 4], "contacts.thumb.point: expected"),
        ("point", ["a", "b", "c"], "contacts.thumb.point[0]: found 'a', expected"),
        ("point", ["1 inch", 0, 0], "unknown unit 'inch'"),
        ("point", None, "contacts.thumb.point: missing, expected three numbers"),
        ("point", {"x": 1}, "contacts.thumb.point: expected"),
        ("colour", "red", "colour"),
    ],
)
def test_bad_contact(
    key: str,
    value: object,
    fragment: str,
    refused: Callable[..., str],
    grasp_file: Callable[..., Path],
    contacts: dict[str, Any],
) -> None:
    path = grasp_file(contacts=contacts | {"thumb": contacts["thumb"] | {key: value}})
    error = refused("solve", path)
    assert error.startswith(f"{path}: ")
    assert fragment in error


@pytest.mark.parametrize(
    ("changes", "fragment"),
    [
        ({"robot": None}, "robot: missing, expected it in the file or --robot"),
        ({"robot": "no_such"}, "robot: no shipped arm-hand is called 'no_such'"),
        ({"robot": "own/no_such.yaml"}, "robot: "),
        ({"colour": "red"}, "colour"),
        ({"posture": {"bh_spread": "wide"}}, "posture.bh_spread: "),
    ],
)
def test_bad_top_level(
    changes: dict[str, Any],
    fragment: str,
    refused: Callable[..., str],
    grasp_file: Callable[..., Path],
) -> None:
    path = grasp_file(**changes)
    error = refused("solve", path)
    assert error.startswith(f"{path}: ")
    assert fragment in error


def test_unknown_finger(
    refused: Callable[..., str], grasp_file: Callable[..., Path], contacts: dict[str, Any]
) -> None:
    path = grasp_file(contacts=contacts | {"pinky": contacts["thumb"]})
    error = refused("solve", path)
    assert error.startswith(f"{path}: contacts.pinky: ")
    assert "thumb, finger_2, finger_3" in error


@pytest.mark.parametrize("left_out", ["finger_3", "finger_3.normal"])
def test_method_that_cannot_take_a_partial_grasp(
    left_out: str,
    refused: Callable[..., str],
    grasp_file: Callable[..., Path],
    contacts: dict[str, Any],
) -> None:
    finger, _, key = left_out.partition(".")
    partial = {name: dict(contact) for name, contact in contacts.items()}
    if key:
        del partial[finger][key]
    else:
        del partial[finger]
    path = grasp_file(contacts=partial)
    error = refused("solve", path, *METHOD)
    assert error.startswith(f"{path}: ")
    assert "enhanced-dls" in error
    assert finger in error


def test_method_that_cannot_take_the_robot(
    refused: Callable[..., str], grasp_file: Callable[..., Path], tmp_path: Path
) -> None:
    hand = tmp_path / "hand_only.yaml"
    hand.write_text(
        "{name: hand_only, hand: barrett_bh8_280, thumb: thumb,"
        " fingers: [thumb, finger_2, finger_3]}"
    )
    error = refused("solve", grasp_file(), *METHOD, "--robot", hand)
    assert error.startswith("--method enhanced-dls: ")
    assert "hand_only" in error


@pytest.mark.parametrize(
    ("name", "fragment"),
    [
        ("nothing", "no shipped grasp is called 'nothing'; shipped: "),
        ("nothing.yaml", "nothing.yaml: no such file"),
        ("/", "/: "),
        ("", "no shipped grasp is called ''"),
    ],
)
def test_missing_grasp(name: str, fragment: str, refused: Callable[..., str]) -> None:
    assert fragment in refused("solve", name)


@pytest.mark.parametrize(
    ("words", "fragment"),
    [
        ("--robot no_such", "--robot: no shipped arm-hand is called 'no_such'"),
        ("--robot ./nowhere.yaml", "nowhere.yaml: no such file"),
        ("--method magic", "--method: found 'magic', expected one of "),
        ("--limits some", "--limits: found 'some', expected one of enforce, ignore"),
        ("--finger-step magic", "--finger-step: found 'magic', expected one of ipopt, closed"),
        ("--q0 1 2 3", "--q0: found 3 numbers, expected 14: lwr_joint_1, "),
        ("--q0 1,2,x", "--q0: found 'x', expected a number"),
        ("--q0 nan", "--q0: found 'nan', expected a finite number"),
        ("--q0 -inf", "--q0: found '-inf', expected a finite number"),
        ("--q0", "--q0: expected"),
        ("--tolerance-position -1", "--tolerance-position: found '-1', expected a number > 0"),
        ("--tolerance-position 0", "--tolerance-position: found '0', expected a number > 0"),
        ("--tolerance-angle nan", "--tolerance-angle: found 'nan', expected a number > 0"),
        ("--tolerance-angle wide", "--tolerance-angle: found 'wide', expected a number > 0"),
        ("--seed -1", "--seed: found '-1', expected a whole number >= 0"),
        ("--seed 1.5", "--seed: found '1.5', expected a whole number >= 0"),
        ("--seed 99999999999999999999", "--seed: found "),
        ("--picture pinch.bmp", "--picture: found 'pinch.bmp', expected a name ending in .png"),
        ("--out=", "--out: found '', expected the name of a file"),
        ("--jobs 2", "--jobs"),
        ("--colour red", "--colour"),
    ],
)
def test_bad_option(
    words: str, fragment: str, refused: Callable[..., str], grasp_file: Callable[..., Path]
) -> None:
    assert fragment in refused("solve", grasp_file(), *words.split())


@pytest.mark.parametrize(
    ("words", "fragment"),
    [
        ("slove cup", "COMMAND: found 'slove', did you mean 'solve'?"),
        ("paint cup", "COMMAND: found 'paint', expected one of solve, batch, "),
        ("solve", "GRASP"),
        ("solve cup apple", "apple"),
        ("batch targets.npz --out o.npz", "--robot"),
        ("batch targets.npz --robot kuka_lwr_barrett", "--out"),
        ("log dump", "found 'dump', expected one of info, "),
        ("log info", "FILE"),
        ("log info nowhere.mcap", "nowhere.mcap: "),
        ("log info .", ".: "),
        ("robots please", "please"),
    ],
)
def test_bad_command(
    words: str, fragment: str, run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # "." is an empty folder, whatever was left where the tests run
    assert fragment in run(*words.split()).error


@pytest.mark.parametrize("content", [b"", b"hello", b"\x89MCAP0\r\n" + bytes(50)])
def test_no_log(content: bytes, run: Command, tmp_path: Path) -> None:
    path = tmp_path / "bad.mcap"
    path.write_bytes(content)
    assert run("log", "info", path).error.startswith(f"{path}: ")
