"""Every bad input: exit code 2, one line that names file, key or option, nothing written."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Command

NAN, INF = float("nan"), float("inf")
METHOD = ("--method", "enhanced-dls", "--finger-step", "closed-form")
ROBOT = ("--robot", "kuka_lwr_barrett")

Refused, Write, Contacts = Callable[..., str], Callable[..., Path], dict[str, Any]


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
def test_bad_grasp_file(name: str, refused: Refused, tmp_path: Path) -> None:
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
    key: str, value: object, fragment: str, refused: Refused, grasp_file: Write, contacts: Contacts
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
    changes: dict[str, Any], fragment: str, refused: Refused, grasp_file: Write
) -> None:
    path = grasp_file(**changes)
    error = refused("solve", path)
    assert error.startswith(f"{path}: ")
    assert fragment in error


def test_unknown_finger(refused: Refused, grasp_file: Write, contacts: Contacts) -> None:
    path = grasp_file(contacts=contacts | {"pinky": contacts["thumb"]})
    error = refused("solve", path)
    assert error.startswith(f"{path}: contacts.pinky: ")
    assert "thumb, finger_2, finger_3" in error


@pytest.mark.parametrize("left_out", ["finger_3", "finger_3.normal"])
def test_method_that_cannot_take_a_partial_grasp(
    left_out: str, refused: Refused, grasp_file: Write, contacts: Contacts
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
    refused: Refused, grasp_file: Write, tmp_path: Path
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
        ("cupp", "no shipped grasp is called 'cupp'; did you mean 'cup'? (or give the path of"),
        ("nothing.yaml", "nothing.yaml: no such file"),
        ("/", "/: "),
        ("", "no shipped grasp is called ''"),
    ],
)
def test_missing_grasp(name: str, fragment: str, refused: Refused) -> None:
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
def test_bad_option(words: str, fragment: str, refused: Refused, grasp_file: Write) -> None:
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


def _changed(array: np.ndarray, where: Any, value: float) -> np.ndarray:
    changed = array.copy()
    changed[where] = value
    return changed


ARRAYS: dict[str, tuple[Callable[[Any, Any], dict[str, Any]], str]] = {
    "no points": (lambda p, n: {"points": None}, "points: missing, expected"),
    "no normals": (lambda p, n: {"normals": None}, "normals: missing, expected"),
    "flat": (lambda p, n: {"points": p[0], "normals": n[0]}, "points: found shape (3, 3)"),
    "scalar": (lambda p, n: {"points": 1.0}, "points: found shape ()"),
    "two fingers": (lambda p, n: {"points": p[:, :2]}, "points: found shape (3, 2, 3)"),
    "rows": (lambda p, n: {"normals": n[:2]}, "found 3 and 2 rows"),
    "no rows": (lambda p, n: {"points": p[:0], "normals": n[:0]}, "points: found no targets"),
    "objects": (
        lambda p, n: {"points": np.array([{}], dtype=object)},
        "points: found values of type object",
    ),
    "text": (lambda p, n: {"points": p.astype(str)}, "points: found values of type <U32"),
    "complex": (lambda p, n: {"normals": n + 1j}, "normals: found values of type complex128"),
    "truth": (lambda p, n: {"normals": n > 0}, "normals: found values of type bool"),
}

ROWS: dict[str, tuple[Callable[[Any, Any], dict[str, Any]], str]] = {
    "infinite": (
        lambda p, n: {"points": _changed(p, (2, 0, 1), INF)},
        "points: row 2, finger 0 is infinite, expected finite numbers",
    ),
    "partly NaN": (
        lambda p, n: {"points": _changed(p, (2, 1, 0), NAN)},
        "points: row 2, finger 1 is partly NaN, expected three numbers or three NaN",
    ),
    "zero normal": (
        lambda p, n: {"normals": _changed(n, (2, 1), 0)},
        "normals: row 2, finger 1 is zero, expected a direction",
    ),
    "no point": (
        lambda p, n: {"points": _changed(p, (2, 1), NAN)},
        "normals: row 2, finger 1 is given for a finger without a point",
    ),
    "no contact": (
        lambda p, n: {"points": _changed(p, 2, NAN), "normals": _changed(n, 2, NAN)},
        "points: row 2 has no contact at all",
    ),
    "free normal": (
        lambda p, n: {"normals": _changed(n, (2, 1), NAN)},
        "method 'enhanced-dls' needs a normal for every finger; row 2 has none for 'finger_2'",
    ),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_bad_targets(name: str, refused: Refused, target_file: Write) -> None:
    change, fragment = ARRAYS[name]
    with np.load(target_file()) as data:
        changes = change(data["points"], data["normals"])
    path = target_file(**changes)
    error = refused("batch", path, *ROBOT, *METHOD)
    assert error.startswith(f"{path}: ")
    assert fragment in error


@pytest.mark.parametrize("name", ROWS)
def test_bad_row_is_named_and_does_not_stop_the_rest(
    name: str, run: Command, target_file: Write, tmp_path: Path
) -> None:
    change, fault = ROWS[name]
    with np.load(target_file(count=5)) as data:
        path = target_file(count=5, **change(data["points"], data["normals"]))
    done = run("batch", path, *ROBOT, *METHOD, "--out", tmp_path / "o.npz")
    assert done.exit == 1
    assert done.err.splitlines() == [
        f"casadi-ik: bad row: {path}: {fault}",
        f"casadi-ik: bad rows: {path}: 1 of 5; their status is INVALID",
    ]
    with np.load(tmp_path / "o.npz", allow_pickle=False) as data:
        assert data["status"].tolist() == ["SOLVED", "SOLVED", "INVALID", "SOLVED", "SOLVED"]
        assert np.isnan(data["q"]).all(axis=1).tolist() == [False, False, True, False, False]


def test_ten_bad_rows_are_named_and_all_counted(
    run: Command, target_file: Write, tmp_path: Path
) -> None:
    with np.load(target_file(count=30)) as data:
        points = _changed(data["points"], (slice(None, None, 2), 0, 0), INF)
    path = target_file(count=30, points=points)
    done = run("batch", path, *ROBOT, *METHOD, "--out", tmp_path / "o.npz")
    lines = done.err.splitlines()
    assert (done.exit, len(lines)) == (1, 11)
    for row, line in zip(range(0, 20, 2), lines, strict=False):
        assert f"points: row {row}, finger 0 is infinite" in line
    assert lines[-1].endswith("15 of 30; their status is INVALID")
    assert "15 INVALID, 15 SOLVED" in done.out


def _zipped(path: Path, members: dict[str, bytes]) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


HEAD = b"\x93NUMPY\x01\x00\x10\x00"
CONTENTS: dict[str, bytes | dict[str, bytes]] = {
    "empty": b"",
    "text": b"hello",
    "pickle": b"\x80\x04}\x94.",
    "no arrays": {"points": b"hello", "normals": b"hello"},
    "bad header": {"points.npy": HEAD + b"{'descr': 'zz'  \n", "normals.npy": HEAD},
    "not a literal": {"points.npy": HEAD + b"import os; 1   \n", "normals.npy": HEAD},
    "cut off": {"points.npy": HEAD[:7], "normals.npy": HEAD[:7]},
}


@pytest.mark.parametrize("name", CONTENTS)
def test_no_targets(name: str, refused: Refused, tmp_path: Path) -> None:
    path, content = tmp_path / "bad.npz", CONTENTS[name]
    if isinstance(content, dict):
        _zipped(path, content)
    else:
        path.write_bytes(content)
    error = refused("batch", path, *ROBOT)
    assert error.startswith(f"{path}: ")


def test_damaged_targets(
    run: Command, target_file: Write, rng: np.random.Generator, tmp_path: Path
) -> None:
    path, out = target_file(), tmp_path / "new.npz"
    whole = path.read_bytes()
    refusals = 0
    for _ in range(60):
        damaged = bytearray(whole)
        start = int(rng.integers(0, len(whole) - 20))
        damaged[start : start + 20] = rng.bytes(20)
        path.write_bytes(damaged)
        done = run("batch", path, *ROBOT, *METHOD, "--out", out)
        if done.exit == 2:
            assert done.error.startswith(f"{path}: ")
            assert list(tmp_path.iterdir()) == [path]
            refusals += 1
        else:  # bytes that nobody reads
            out.unlink()
    assert refusals > 40


@pytest.mark.parametrize(
    ("name", "says"), [("nowhere.npz", "cannot be read"), (".", "found no .npz or .parquet file")]
)
def test_missing_targets(name: str, says: str, refused: Refused, tmp_path: Path) -> None:
    error = refused("batch", tmp_path / name, *ROBOT)
    assert says in error
