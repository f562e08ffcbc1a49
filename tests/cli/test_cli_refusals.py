"""Bad input: exit code 2, one line that says where, what was found and expected, nothing written.

What is wrong *in* files, of grasps, targets, robots, logs, is tested with what reads them; here it
is that the command line says it, of which file, and the options of its own.
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
    "short.csv": b"finger,index_proximal_slider,index_middle_slider,x,y,z\nindex,0.05,0,0,0\n",
    "none.csv": b"finger,index_proximal_slider,index_middle_slider,x,y,z\n",
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
slove good.yaml => COMMAND: found 'slove', did you mean 'solve'? (see casadi-ik --help)
paint => COMMAND: found 'paint', expected one of solve, batch,
log evnts => COMMAND: found 'evnts', did you mean 'events'? (see casadi-ik log --help)
robots please => found 'please', expected nothing
solve => the following arguments are required: GRASP
solve good.yaml apple => found 'apple', expected nothing behind GRASP
solve good.yaml --tolerence-angle 1 => --tolerence-angle: no such option, did you mean '--tolerance
solve good.yaml --colour red => --colour: no such option
solve good.yaml --jobs 2 => --jobs: no such option
completion tcsh => SHELL: found 'tcsh', expected one of bash, zsh, fish

solve cpu => no shipped grasp is called 'cpu'; did you mean 'cup'?
solve nothing => no shipped grasp is called 'nothing'; shipped: allegro_cup,
solve nothing.yaml => nothing.yaml: no such file
solve / => /:
solve broken.yaml => broken.yaml:
solve binary.yaml => binary.yaml: cannot be read: not UTF-8
solve code.yaml => code.yaml:1:1: not valid YAML: could not
solve nan.yaml => nan.yaml: contacts.thumb.point[0]: found nan, expected a finite number
solve zero.yaml => zero.yaml: contacts.thumb.normal: found [0.0, 0.0, 0.0], expected
solve unit.yaml => unknown unit 'inch'
solve pinky.yaml => pinky.yaml: contacts.pinky: no such finger; the robot's fingers: thumb, finger_2
solve no_robot.yaml => no_robot.yaml: robot: missing, expected it in the file or --robot
solve other.yaml => other.yaml: robot: no shipped arm-hand is called 'no_such'
solve two.yaml --method enhanced-dls => two.yaml: points: row 0
solve good.yaml --method enhanced-dls --robot hand_only.yaml => --method enhanced-dls:

solve good.yaml --robot pandas => no shipped arm-hand is called 'pandas'; did you mean 'panda'?
solve good.yaml --robot ./no.yaml => no.yaml: no such file
solve good.yaml --method hand-fist => --method: found 'hand-fist', did you mean 'hand-first'?
solve good.yaml --method x => --method: found 'x', expected one of hand-first,
solve good.yaml --scene tabel => --scene: no shipped scene is called 'tabel'; did you mean 'table'?
solve good.yaml --limits some => --limits: found 'some', expected one of enforce, ignore
solve good.yaml --finger-step magic => --finger-step: found 'magic', expected one of ipopt, closed
solve good.yaml --prefer clearance => needs a solver with a scene
solve good.yaml --q0 1 2 3 => --q0: found 3 numbers, expected 14: lwr_joint_1,
solve good.yaml --q0 1,2,x => --q0: found 'x', expected a number
solve good.yaml --q0 -inf => --q0: found '-inf', expected a finite number
solve good.yaml --q0 => --q0: expected
solve good.yaml --object-pose 1 2 => --object-pose: found 2 numbers, expected 6: x y z [m] roll
solve good.yaml --tolerance-position -1 => --tolerance-position: found '-1', expected a number > 0
solve good.yaml --tolerance-angle nan => --tolerance-angle: found 'nan', expected a number > 0
solve good.yaml --seed -1 => --seed: found '-1', expected a whole number >= 0
solve good.yaml --seed 99999999999999999999 => --seed: found
solve good.yaml --fixed lwr_joint_3=9 => fixed.lwr_joint_3: found 9.0, expected a number from -2.9
solve good.yaml --fixed elbow=0 => fixed: no actuator 'elbow', expected one of lwr_joint_1,
solve good.yaml --fixed lwr_joint_3 => --fixed: found 'lwr_joint_3', expected NAME=NUMBER
solve good.yaml --fixed lwr_joint_3=0 lwr_joint_3=1 => --fixed: lwr_joint_3 appears twice
solve good.yaml --max-rounds 1 --method thumb-first => --max-rounds: option 'max_rounds' does not
solve good.yaml --picture a.bmp => --picture: found 'a.bmp', expected a name ending in .png
solve good.yaml --out= => --out: found '', expected the name of a file
solve good.yaml --out a.parquet => --out: found 'a.parquet', expected a name ending in .json

batch targets.npz --out o.npz => the following arguments are required: --robot
batch targets.npz {ROBOT} => the following arguments are required: --out
batch targets.npz {ROBOT} --out o.csv => --out: found 'o.csv', expected OUT.npz, OUT.parquet or
batch no.npz {ROBOT} --out o.npz => no.npz: cannot be read: No such file
batch empty {ROBOT} --out o.npz => empty: contains no .npz or .parquet file
batch text.npz {ROBOT} --out o.npz => text.npz: not an npz file
batch no_points.npz {ROBOT} --out o.npz => no_points.npz: points: missing, expected
batch flat.npz {ROBOT} --out o.npz => flat.npz: points: found shape (3, 3)
batch rows.npz {ROBOT} --out o.npz => found 3 and 2 rows
batch no_rows.npz {ROBOT} --out o.npz => points: found no targets
batch objects.npz {ROBOT} --out o.npz => points: found values of type object
batch words.npz {ROBOT} --out o.npz => points: found values of type <U32
batch odd.npz {ROBOT} --out o.npz => odd.npz: points: cannot be read

choose empty_list.yaml {ROBOT} --out r.json => candidates: found none, expected at least one grasp
choose elbow.yaml {ROBOT} --out r.json => contacts.elbow: no such finger
choose empty {ROBOT} --out r.json => empty: found no YAML file, expected grasp files
choose no.yaml {ROBOT} --out r.json => no.yaml: no such file or folder
choose free.npz {ROBOT} --out r.json => free.npz: row 0: contacts: found none
choose in_mm.npz {ROBOT} --out r.json => expected at most 5 m (numbers in mm?)
choose targets.npz {ROBOT} --prefer best --out r.json => --prefer: found 'best'
choose targets.npz {ROBOT} --prefer clearance --out r.json => needs a solver with a scene
choose targets.npz {ROBOT} --limit 0 --out r.json => --limit: found '0', expected a whole num
choose targets.npz {ROBOT} --layout mine --out r.json => --layout: found 'mine', expected one of
choose targets.npz {ROBOT} --out r.parquet => --out: found 'r.parquet', expected a name ending in

follow twenty.npz {ROBOT} --out m.npz => keypoints: found shape (4, 20, 3), expected
follow neither.npz {ROBOT} --out m.npz => expected keypoints (k, 21, 3) or points (k, 3, 3); found
follow no_rows.npz {ROBOT} --out m.npz => points: found shape (0, 3, 3), expected
follow words.npz {ROBOT} --out m.npz => points: found values of type
follow in_mm.npz {ROBOT} --out m.npz => expected at most 5 m (numbers in mm?)
follow back.npz {ROBOT} --out m.npz => times: expected 2 growing numbers
follow extra.npz {ROBOT} --out m.npz => extra: unknown, expected
follow targets.npz {ROBOT} --period 0 --out m.npz => --period: found '0'
follow targets.npz {ROBOT} --retarget no.yaml --out m.npz => no.yaml: cannot be read
follow targets.npz {ROBOT} --retarget sides.yaml --out m.npz => sides.yaml: sides.left
follow targets.npz --out m.npz => --robot: missing, expected it here or as robot in --retarget
follow torn.npz {ROBOT} --out m.npz => torn.npz: not an npz file
follow targets.npz {ROBOT} --out m.parquet => expected a name ending in .mcap, .npz, .csv
reach cup --q0 1 2 --out w.npz => --q0: found 2 numbers, expected 14
reach cup --rank 2 --out w.npz => --rank: expected it with
reach cup --direction 1 --out w.npz => --direction: found 1 numbers, expected 3
reach cup --direction 0 0 0 --out w.npz => --direction: found three zeros

calibrate none.csv --robot ar10 --out c.yaml => none.csv
calibrate toe.csv --robot ar10 --out c.yaml => toe.csv:2: finger: found 'toe', expected one of
calibrate short.csv --robot ar10 --out c.yaml => short.csv:2: found 5 columns, the header has 6
calibrate no.csv --robot ar10 --out c.yaml => no.csv
calibrate toe.csv --robot ar10 --loss median --out c.yaml => --loss: found 'median'
calibrate toe.csv --robot ar10 --estimate screws --out c.yaml => --estimate: found 'screws'
calibrate toe.csv --robot ar10 --out c.json => found 'c.json', expected a name ending in .yaml

view cup --port 99999 => --port: found '99999', expected a whole number from 1 to 65535
view cpu => shipped robot (casadi-ik robots); did you mean 'cup'?
log info => the following arguments are required: FILE
log info no.mcap => no.mcap:
log info empty => empty:
log info text.mcap => text.mcap:
log solves log.mcap --status SOLV => log.mcap: no status 'SOLV'; there are:
log solves log.mcap --method paper => log.mcap: no method 'paper'; the log holds: hand-first
log solves log.mcap --most 0 => --most: found '0', expected a whole number >= 1
log events log.mcap --event BOOM => log.mcap: no event 'BOOM'; there are:
log events log.mcap --phase nap => log.mcap: no phase 'nap'; there are:
log why log.mcap 99 => log.mcap: no solve 99; the log holds: hand-first solves 1 to 3
log why log.mcap --solve 99 => log.mcap: no solve 99; the log holds: hand-first solves 1 to 3
log plot log.mcap => log.mcap: which solve?; the log holds: hand-first solves 1 to 3
log plot log.mcap 1 --out a.jpg => --out: found 'a.jpg', expected a name ending in .png
log plot log.mcap 1 --out no/a.png => no/a.png: --out: cannot be written
log compare log.mcap => the logs hold hand-first, expected two methods (say --methods)
log compare log.mcap --methods paper hand-first => --methods: found 'paper', the logs hold
log export log.mcap --solve 1 --out a.txt => --out: found 'a.txt', expected
log export log.mcap --solve 1 --out log.mcap => log.mcap: --out: found the file of the input
log export log.mcap --out view.mcap => log.mcap: which solve?; the log holds
log export log.mcap --solve 1 --robot x --out v.mcap => log.mcap: robot (say --robot): no shipped a
log export log.mcap --solve 1 --robot ar10 --out v.mcap => log.mcap: the robot 'ar10' is not the one
log export log.mcap --what rows --out a.csv => --what: found 'rows', expected one of
log finish no.mcap => no.mcap: cannot finish the log: No such
log merge log.mcap log.mcap --out all.mcap => log.mcap: solve 1 of hand-first is in log.mcap
log merge log.mcap --out log.mcap => log.mcap: --out: found the file of the input
log merge log.mcap => the following arguments are required: --out
"""
LINES = [line for line in CASES.splitlines() if line]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, robot: ik.ArmHand) -> Path:
    """A folder with all files that are spoken of."""
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
    before = sorted(place.rglob("*"))
    assert expected in run(*words.split()).error
    assert sorted(place.rglob("*")) == before


def test_a_refusal_of_a_process(run_process: Command, place: Path) -> None:
    assert "no solve 99" in run_process("log", "why", place / "log.mcap", 99).error


def _changed(array: np.ndarray, where: Any, value: float) -> np.ndarray:
    changed = array.copy()
    changed[where] = value
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
def test_bad_rows_are_named_and_do_not_stop_the_rest(
    change: Callable[..., Any],
    fault: str,
    run: Command,
    target_file: Callable[..., Path],
    robot: ik.ArmHand,
    tmp_path: Path,
) -> None:
    """The first ten of them; all are counted."""
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
    whole = path.read_bytes()
    refusals = 0
    for _ in range(60):
        damaged = bytearray(whole)
        start = int(rng.integers(0, len(whole) - 20))
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
    "rank": (lambda _: None, "--rank: found 4, but"),
    "pose": (lambda _: None, "--object-pose: other.json says where its objects are"),
}


@pytest.mark.parametrize("case", RANKED)
def test_what_ranked_files_are_refused(
    case: str, run: Command, ranked: Path, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    change, says = RANKED[case]
    data = json.loads(ranked.read_text())
    change(data)
    monkeypatch.chdir(place)
    Path("other.json").write_text(json.dumps(data))
    more = {"rank": ("--rank", "4"), "pose": ("--object-pose", *"000000")}.get(case, ())
    assert says in run("reach", "other.json", "--out", "way.npz", *more).error
    assert not Path("way.npz").exists()
