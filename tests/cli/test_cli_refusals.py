"""Bad input: exit code 2, one line on stderr with location and value, and no output files.

Errors in the contents of files are tested with their readers. These tests check that the command
line reports them with the file or option. A case lists words that the error must contain.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import Command, solvable

import casadi_ik as ik

NAN, INF = float("nan"), float("inf")

GRASPS: dict[str, Callable[[dict[str, Any]], object]] = {
    "good": lambda contacts: {"contacts": contacts},
    "nan": lambda contacts: {"contacts": contacts | {"thumb": {"point": [NAN] * 3}}},
    "zero": lambda contacts: {"contacts": {"thumb": contacts["thumb"] | {"normal": [0, 0, 0]}}},
    "unit": lambda contacts: {"contacts": {"thumb": {"point": ["1 inch", 0, 0]}}},
    "pinky": lambda contacts: {"contacts": contacts | {"pinky": contacts["thumb"]}},
    "two": lambda contacts: {"contacts": {k: contacts[k] for k in ("thumb", "finger_2")}},
    "no_robot": lambda contacts: {"contacts": contacts, "robot": None},
    "other": lambda contacts: {"contacts": contacts, "robot": "no_such"},
    "elbow": lambda contacts: {"candidates": [{"contacts": {"elbow": contacts["thumb"]}}]},
    "empty_list": lambda _: {"candidates": []},
}
BYTES = {
    "broken.yaml": b"robot: [1,\n  a: b",
    "binary.yaml": bytes(range(256)),
    "code.yaml": b"!!python/object/apply:os.system ['echo hi']",
    "sides.yaml": b"sides: {left: {fingers: {thumb: 4}}}",
    "text.npz": b"hello",
    "text.mcap": b"hello",
    "torn.npz": b"PK",
    "hand_only.yaml": b"{name: hand_only, hand: barrett_bh8_280, thumb: thumb, fingers: [thumb, "
    b"finger_2, finger_3]}",
    "toe.csv": b"finger,index_proximal_slider,index_middle_slider,x,y,z\ntoe,0.05,0.05,0,0,0\n",
}
ARRAYS: dict[str, Callable[[Any, Any], dict[str, Any]]] = {
    "targets": lambda p, n: {"points": p, "normals": n},
    "no_points": lambda p, n: {"normals": n},
    "flat": lambda p, n: {"points": p[0], "normals": n[0]},
    "rows": lambda p, n: {"points": p, "normals": n[:2]},
    "no_rows": lambda p, n: {"points": p[:0], "normals": n[:0]},
    "objects": lambda p, n: {"points": np.array([{}], dtype=object), "normals": n},
    "words": lambda p, n: {"points": p.astype(str), "normals": n},
    "free": lambda p, n: {"points": np.full((1, 3, 3), NAN), "normals": np.full((1, 3, 3), NAN)},
    "in_mm": lambda p, n: {"points": 1e3 * p, "normals": n},
    "twenty": lambda p, n: {"keypoints": np.zeros((4, 20, 3))},
    "neither": lambda p, n: {"other": np.zeros(3)},
    "back": lambda p, n: {"points": np.zeros((2, 3, 3)), "times": [1.0, 0.0]},
    "extra": lambda p, n: {"points": p, "extra": [1.0]},
}

ROBOT = "--robot kuka_lwr_barrett"
CASES = f"""
slove good.yaml => COMMAND 'slove' 'solve' --help
paint => COMMAND 'paint'
log evnts => COMMAND 'evnts' 'events' --help
robots please => 'please'
solve => GRASP
solve good.yaml apple => 'apple' GRASP
solve good.yaml --tolerence-angle 1 => --tolerence-angle '--tolerance
solve good.yaml --colour red => --colour
solve good.yaml --jobs 2 => --jobs
completion tcsh => SHELL 'tcsh'

solve cpu => 'cpu' 'cup'
solve nothing => 'nothing' allegro_cup
solve nothing.yaml => nothing.yaml
solve / => /
solve broken.yaml => broken.yaml
solve binary.yaml => binary.yaml
solve code.yaml => code.yaml:1:1
solve nan.yaml => nan.yaml contacts.thumb.point[0]
solve zero.yaml => zero.yaml contacts.thumb.normal 0.0
solve unit.yaml => 'inch'
solve pinky.yaml => pinky.yaml contacts.pinky thumb finger_2
solve no_robot.yaml => no_robot.yaml robot --robot
solve other.yaml => other.yaml robot 'no_such'
solve two.yaml --method enhanced-dls => two.yaml points
solve good.yaml --method enhanced-dls --robot hand_only.yaml => --method enhanced-dls

solve good.yaml --robot pandas => 'pandas' 'panda'
solve good.yaml --robot ./no.yaml => no.yaml
solve good.yaml --method hand-fist => --method 'hand-fist' 'hand-first'
solve good.yaml --method x => --method 'x'
solve good.yaml --scene tabel => --scene 'tabel' 'table'
solve good.yaml --limits some => --limits 'some'
solve good.yaml --finger-step magic => --finger-step 'magic'
solve good.yaml --prefer clearance => scene
solve good.yaml --q0 1 2 3 => --q0 3 14 lwr_joint_1
solve good.yaml --q0 1,2,x => --q0 'x'
solve good.yaml --q0 -inf => --q0 '-inf'
solve good.yaml --q0 => --q0
solve good.yaml --object-pose 1 2 => --object-pose 2 6
solve good.yaml --tolerance-position -1 => --tolerance-position '-1' 0
solve good.yaml --tolerance-angle nan => --tolerance-angle 'nan' 0
solve good.yaml --seed -1 => --seed '-1' 0
solve good.yaml --seed 99999999999999999999 => --seed
solve good.yaml --fixed lwr_joint_3=9 => fixed.lwr_joint_3 9.0 -2.9
solve good.yaml --fixed elbow=0 => fixed 'elbow' lwr_joint_1
solve good.yaml --fixed lwr_joint_3 => --fixed 'lwr_joint_3'
solve good.yaml --fixed lwr_joint_3=0 lwr_joint_3=1 => --fixed lwr_joint_3
solve good.yaml --max-rounds 1 --method thumb-first => --max-rounds 'max_rounds'
solve good.yaml --picture a.bmp => --picture 'a.bmp'
solve good.yaml --out= => --out ''
solve good.yaml --out a.parquet => --out 'a.parquet'

batch targets.npz --out o.npz => --robot
batch targets.npz {ROBOT} => --out
batch targets.npz {ROBOT} --out o.csv => --out 'o.csv' OUT.npz OUT.parquet
batch no.npz {ROBOT} --out o.npz => no.npz
batch empty {ROBOT} --out o.npz => empty
batch text.npz {ROBOT} --out o.npz => text.npz
batch no_points.npz {ROBOT} --out o.npz => no_points.npz points
batch flat.npz {ROBOT} --out o.npz => flat.npz points (3, 3)
batch rows.npz {ROBOT} --out o.npz => 3 2
batch no_rows.npz {ROBOT} --out o.npz => points
batch objects.npz {ROBOT} --out o.npz => points
batch words.npz {ROBOT} --out o.npz => points
batch odd.npz {ROBOT} --out o.npz => odd.npz points

choose empty_list.yaml {ROBOT} --out r.json => candidates
choose elbow.yaml {ROBOT} --out r.json => contacts.elbow
choose empty {ROBOT} --out r.json => empty
choose no.yaml {ROBOT} --out r.json => no.yaml
choose torn.npz {ROBOT} --out r.json => torn.npz
choose text.npz {ROBOT} --out r.json => text.npz
choose free.npz {ROBOT} --out r.json => free.npz 0 contacts
choose in_mm.npz {ROBOT} --out r.json => 5
choose targets.npz {ROBOT} --prefer best --out r.json => --prefer 'best'
choose targets.npz {ROBOT} --prefer clearance --out r.json => scene
choose targets.npz {ROBOT} --limit 0 --out r.json => --limit '0'
choose targets.npz {ROBOT} --layout mine --out r.json => --layout 'mine'
choose targets.npz {ROBOT} --out r.parquet => --out 'r.parquet'

follow twenty.npz {ROBOT} --out m.npz => keypoints (4, 20, 3)
follow neither.npz {ROBOT} --out m.npz => 21 3
follow no_rows.npz {ROBOT} --out m.npz => points (0, 3, 3)
follow words.npz {ROBOT} --out m.npz => points
follow in_mm.npz {ROBOT} --out m.npz => 5
follow back.npz {ROBOT} --out m.npz => times 2
follow extra.npz {ROBOT} --out m.npz => extra
follow targets.npz {ROBOT} --period 0 --out m.npz => --period '0'
follow targets.npz {ROBOT} --retarget no.yaml --out m.npz => no.yaml
follow targets.npz {ROBOT} --retarget sides.yaml --out m.npz => sides.yaml sides.left
follow targets.npz --out m.npz => --robot --retarget
follow torn.npz {ROBOT} --out m.npz => torn.npz
follow targets.npz {ROBOT} --out m.parquet => 'm.parquet' .mcap .npz .csv
reach cup --q0 1 2 --out w.npz => --q0 2 14
reach cup --rank 2 --out w.npz => --rank
reach cup --direction 1 --out w.npz => --direction 1 3
reach cup --direction 0 0 0 --out w.npz => --direction

calibrate no.csv --robot ar10 --out c.yaml => no.csv
calibrate toe.csv --robot ar10 --loss median --out c.yaml => --loss 'median'
calibrate toe.csv --robot ar10 --estimate screws --out c.yaml => --estimate 'screws'
calibrate toe.csv --robot ar10 --out c.json => 'c.json'

view cup --port 99999 => --port '99999' 1 65535
view cpu => 'cpu' 'cup'
view cup mug => 2 names
view cup --method x => --method 'x'
view cup --pads => --pads
view cup --host 192.0.2.1 => host '192.0.2.1'
view no.mcap => no.mcap
view no.json => no.json
log info => FILE
log info no.mcap => no.mcap
log info empty => empty
log info text.mcap => text.mcap
log solves log.mcap --status SOLV => log.mcap 'SOLV'
log solves log.mcap --method paper => log.mcap 'paper'
log solves log.mcap --most 0 => --most '0' 1
log events log.mcap --event BOOM => log.mcap 'BOOM'
log events log.mcap --phase nap => log.mcap 'nap'
log why log.mcap 99 => log.mcap 99 1 3
log why log.mcap --solve 99 => log.mcap 99 1 3
log plot log.mcap => log.mcap 1 3
log plot log.mcap 1 --out a.jpg => --out 'a.jpg'
log plot log.mcap 1 --out no/a.png => no/a.png --out
log compare log.mcap => --methods
log compare log.mcap --methods paper hand-first => --methods 'paper'
log export log.mcap --solve 1 --out a.txt => --out 'a.txt'
log export log.mcap --solve 1 --out log.mcap => log.mcap --out
log export log.mcap --out view.mcap => log.mcap
log export log.mcap --solve 1 --robot x --out v.mcap => log.mcap --robot
log export log.mcap --solve 1 --robot ar10 --out v.mcap => log.mcap 'ar10'
log export log.mcap --what rows --out a.csv => --what 'rows'
log finish no.mcap => no.mcap
log merge log.mcap log.mcap --out all.mcap => log.mcap 1
log merge log.mcap --out log.mcap => log.mcap --out
log merge log.mcap => --out
"""
LINES = [line for line in CASES.splitlines() if line]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, robot: ik.ArmHand) -> Path:
    """Folder with all files that the cases name."""
    folder, (points, normals) = tmp_path_factory.mktemp("refusals"), solvable(robot, 3)
    rows = zip(robot.fingers, points[0].tolist(), normals[0].tolist(), strict=True)
    contacts = {name: {"point": point, "normal": normal} for name, point, normal in rows}
    for name, data in GRASPS.items():
        content = {"robot": robot.name} | data(contacts)  # type: ignore[operator]
        text = yaml.safe_dump({k: v for k, v in content.items() if v is not None})
        (folder / f"{name}.yaml").write_text(text)
    for name, data in BYTES.items():
        (folder / name).write_bytes(data)
    for name, arrays in ARRAYS.items():
        np.savez(folder / f"{name}.npz", **arrays(points, normals))
    with zipfile.ZipFile(folder / "odd.npz", "w") as archive:
        for name in ("points.npy", "normals.npy"):
            archive.writestr(name, b"\x93NUMPY\x01\x00\x10\x00import os; 1   \n")
    (folder / "empty").mkdir()
    ik.Solver(robot).solve_batch(points, normals, log=folder / "log.mcap")
    return folder


@pytest.mark.parametrize("line", LINES, ids=[line.partition(" => ")[0] for line in LINES])
def test_one_line_and_nothing_written(
    line: str, run: Command, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words, _, expected = line.partition(" => ")
    monkeypatch.chdir(place)
    files_before = sorted(place.rglob("*"))
    error = run(*words.split()).error
    assert all(part in error for part in expected.split()), error
    assert sorted(place.rglob("*")) == files_before


def test_process_reports_refusal(run_process: Command, place: Path) -> None:
    assert "log.mcap: solve 99 " in run_process("log", "why", place / "log.mcap", 99).error


def _changed(array: np.ndarray, index: Any, value: float) -> np.ndarray:
    changed = array.copy()
    changed[index] = value
    return changed


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (
            lambda p, n: {"points": _changed(p, (slice(None, None, 2), 0, 0), INF), "normals": n},
            "points: row {row}, finger 0 is infinite, expected finite numbers",
        ),
        (
            lambda p, n: {"points": p, "normals": _changed(n, (slice(None, None, 2), 1), 0)},
            "normals: row {row}, finger 1 is zero, expected a direction",
        ),
    ],
)
def test_bad_rows_are_named_and_the_others_solved(
    change: Callable[..., Any],
    fault: str,
    run: Command,
    target_file: Callable[..., Path],
    robot: ik.ArmHand,
    tmp_path: Path,
) -> None:
    """The first ten bad rows are named; all of them are counted."""
    path, out = target_file(**change(*solvable(robot, 30))), tmp_path / "o.npz"
    done = run("batch", path, *ROBOT.split(), "--out", out)
    named = [f"casadi-ik: bad row: {path}: {fault.format(row=row)}" for row in range(0, 20, 2)]
    counted = f"casadi-ik: bad rows: {path}: 15 of 30; their status is INVALID"
    assert (done.exit, done.err.splitlines()) == (1, [*named, counted])
    assert "15 INVALID, 15 SOLVED" in done.out
    with np.load(out, allow_pickle=False) as data:
        assert data["status"].tolist() == ["INVALID", "SOLVED"] * 15
        assert np.isnan(data["q"]).all(axis=1).tolist() == [True, False] * 15


def test_damaged_targets(
    run: Command, target_file: Callable[..., Path], rng: np.random.Generator, tmp_path: Path
) -> None:
    path, out = target_file(), tmp_path / "new.npz"
    data = path.read_bytes()
    refusals = 0
    for _ in range(60):
        damaged = bytearray(data)
        start = int(rng.integers(0, len(data) - 20))
        damaged[start : start + 20] = rng.bytes(20)
        path.write_bytes(damaged)
        done = run("batch", path, *ROBOT.split(), "--out", out)
        if done.exit == 2:
            assert done.error.startswith(f"{path}: ")
            assert list(tmp_path.iterdir()) == [path]
            refusals += 1
        else:  # bytes that nobody reads
            out.unlink()
    assert refusals > 40


RANKED: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "none": (lambda data: data["ranked"].clear(), "ranked: found none"),
    "no grasp": (lambda data: data["ranked"][0].pop("grasp"), "ranked[0].grasp: missing"),
    "no point": (
        lambda data: data["ranked"][0]["grasp"]["contacts"]["thumb"].pop("point"),
        "ranked[0].grasp.contacts.thumb.point: missing",
    ),
    "short": (lambda data: data["ranked"][0]["solution"].update(q=[1, 2]), "q: found shape (2,)"),
    "words": (lambda data: data["ranked"][0]["solution"].update(q=["a"]), "Expected `float`"),
    "rank": (lambda _: None, "--rank: found 4, expected at most"),
    "pose": (lambda _: None, "--object-pose: other.json"),
}


@pytest.mark.parametrize("case", RANKED)
def test_bad_ranked_files_are_refused(
    case: str, run: Command, ranked: Path, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    change, says = RANKED[case]
    data = json.loads(ranked.read_text())
    change(data)
    monkeypatch.chdir(place)
    Path("other.json").write_text(json.dumps(data))
    options = {"rank": ("--rank", "4"), "pose": ("--object-pose", *"000000")}.get(case, ())
    assert says in run("reach", "other.json", "--out", "way.npz", *options).error
    assert not Path("way.npz").exists()
