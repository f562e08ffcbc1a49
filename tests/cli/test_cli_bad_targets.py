"""Every bad file of targets: exit code 2, one line that names file and key, nothing written."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Command

NAN, INF = float("nan"), float("inf")
METHOD = ("--method", "enhanced-dls", "--finger-step", "closed-form")


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
def test_bad_targets(
    name: str, refused: Callable[..., str], target_file: Callable[..., Path]
) -> None:
    change, fragment = ARRAYS[name]
    with np.load(target_file()) as data:
        changes = change(data["points"], data["normals"])
    path = target_file(**changes)
    error = refused("batch", path, "--robot", "kuka_lwr_barrett", *METHOD)
    assert error.startswith(f"{path}: ")
    assert fragment in error


@pytest.mark.parametrize("name", ROWS)
def test_bad_row_is_named_and_does_not_stop_the_rest(
    name: str, run: Command, target_file: Callable[..., Path], tmp_path: Path
) -> None:
    change, fault = ROWS[name]
    with np.load(target_file(count=5)) as data:
        path = target_file(count=5, **change(data["points"], data["normals"]))
    done = run("batch", path, "--robot", "kuka_lwr_barrett", *METHOD, "--out", tmp_path / "o.npz")
    assert done.exit == 1
    assert done.err.splitlines() == [
        f"casadi-ik: bad row: {path}: {fault}",
        f"casadi-ik: bad rows: {path}: 1 of 5; their status is INVALID",
    ]
    with np.load(tmp_path / "o.npz", allow_pickle=False) as data:
        assert data["status"].tolist() == ["SOLVED", "SOLVED", "INVALID", "SOLVED", "SOLVED"]
        assert np.isnan(data["q"]).all(axis=1).tolist() == [False, False, True, False, False]


def test_ten_bad_rows_are_named_and_all_counted(
    run: Command, target_file: Callable[..., Path], tmp_path: Path
) -> None:
    with np.load(target_file(count=30)) as data:
        points = _changed(data["points"], (slice(None, None, 2), 0, 0), INF)
    path = target_file(count=30, points=points)
    done = run("batch", path, "--robot", "kuka_lwr_barrett", *METHOD, "--out", tmp_path / "o.npz")
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
def test_no_targets(name: str, refused: Callable[..., str], tmp_path: Path) -> None:
    path, content = tmp_path / "bad.npz", CONTENTS[name]
    if isinstance(content, dict):
        _zipped(path, content)
    else:
        path.write_bytes(content)
    error = refused("batch", path, "--robot", "kuka_lwr_barrett")
    assert error.startswith(f"{path}: ")


def test_damaged_targets(
    run: Command, target_file: Callable[..., Path], rng: np.random.Generator, tmp_path: Path
) -> None:
    path, out = target_file(), tmp_path / "new.npz"
    whole = path.read_bytes()
    refusals = 0
    for _ in range(60):
        damaged = bytearray(whole)
        start = int(rng.integers(0, len(whole) - 20))
        damaged[start : start + 20] = rng.bytes(20)
        path.write_bytes(damaged)
        done = run("batch", path, "--robot", "kuka_lwr_barrett", *METHOD, "--out", out)
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
def test_missing_targets(name: str, says: str, refused: Callable[..., str], tmp_path: Path) -> None:
    error = refused("batch", tmp_path / name, "--robot", "kuka_lwr_barrett")
    assert says in error
