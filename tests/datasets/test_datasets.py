"""Public data sets of grasps are read as their layouts define them; no code in them is executed."""

from __future__ import annotations

import json
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import main
from make_grasp_sets import ROBOTS, TABLES, Written, made
from torch_zip import write_torch

import casadi_ik as ik
from casadi_ik.app.report import reasons
from casadi_ik.integrations.datasets.layouts import load_convention
from casadi_ik.integrations.datasets.postures import HandPoses
from casadi_ik.model.joints import link_poses
from casadi_ik.model.objects import load_object

PUBLISHED = json.loads((Path(__file__).parent / "published_hands.json").read_text())
KUKA = "kuka_lwr_barrett"


@pytest.mark.parametrize("name", [*ik.shipped_names("datasets"), *TABLES])
def test_round_trip(name: str, tmp_path: Path) -> None:
    """Palms, postures and fingertips equal those that a file was made from."""
    if name.endswith(".parquet"):
        pytest.importorskip("polars")
    written = made(name, tmp_path)
    robot, motors = written.robot, written.robot.description.finger_motors
    columns = [robot.actuators.index(motor) for motor in motors]
    grasps = ik.load_candidates(written.path, robot)
    assert len(grasps) == len(written.q)
    for grasp, q, palm in zip(grasps, written.q, written.palms, strict=True):
        assert grasp.palm == pytest.approx(palm, abs=2e-6)
        assert list(grasp.posture) == list(motors)
        assert list(grasp.posture.values()) == pytest.approx(q[columns].tolist(), abs=2e-6)
    points, normals = robot.contacts(written.q)
    back = written.palms @ np.linalg.inv(robot.palm(written.q))
    points = points @ np.swapaxes(back[:, :3, :3], 1, 2) + back[:, None, :3, 3]
    normals = normals @ np.swapaxes(back[:, :3, :3], 1, 2)
    for i, grasp in enumerate(ik.load_candidates(written.path, robot, take="contacts")):
        arrays = grasp.arrays(robot.fingers)
        assert arrays[0] == pytest.approx(points[i], abs=3e-6)
        assert arrays[1] == pytest.approx(normals[i], abs=3e-6)


@pytest.mark.parametrize("name", sorted(PUBLISHED))
def test_conventions_agree_with_the_published_hands(name: str) -> None:
    """The poses of distal links equal those of another library with the published model."""
    published, convention = PUBLISHED[name], load_convention(name)
    described = ik.load_robot(ROBOTS.get(name.split("_")[1], KUKA)).description
    values = np.array([list(published["joints"].values())])
    hand_poses = HandPoses(
        "", np.zeros((1, 3)), np.eye(3)[None], values, tuple(published["joints"])
    )
    positions = {name: float(value[0]) for name, value in convention.positions(hand_poses).items()}
    poses = link_poses(described.root, described.joints, positions)
    back = convention.frames(hand_poses)[0] @ np.linalg.inv(poses[convention.link])
    children = {joint.name: joint.child for joint in described.joints}
    # The little finger of DexGraspNet's model starts 1.7 mm beside that of the hand.
    within = 2e-3 if name == "dexgraspnet_shadow" else 1.5e-4
    for theirs, place in published["last"].items():
        ours = back @ poses[children[convention.joints[theirs][0]]]
        assert ours[:3, 3] == pytest.approx(place, abs=within), theirs


def test_palm_poses_are_reached(tmp_path: Path) -> None:
    """`solve`, `solve_all`, `choose` and YAML files take a palm and a posture as given."""
    robot = ik.load_robot(KUKA)
    solver = ik.Solver(robot)
    q = robot.random(np.random.default_rng(3), 6)
    motors = robot.description.finger_motors
    columns = [robot.actuators.index(motor) for motor in motors]
    grasps = [
        ik.Grasp(palm=pose, posture=dict(zip(motors, row[columns].tolist(), strict=True)))
        for pose, row in zip(robot.palm(q), q, strict=True)
    ]
    for grasp, row in zip(grasps, q, strict=True):
        solution = solver.solve(grasp)
        assert solution.success
        assert solution.palm is not None
        assert solution.palm.ok
        assert solution.palm.position_error < 1e-4
        assert solution.q[columns] == pytest.approx(row[columns], abs=1e-9)
        assert robot.palm(solution.q) == pytest.approx(grasp.palm, abs=1e-3)
    place = np.eye(4)
    place[:3, 3] = 0.1, -0.2, 0.05
    ranked = solver.choose([grasp.at(np.linalg.inv(place)) for grasp in grasps], place, limit=40)
    assert ranked.answered == len(grasps)
    for choice in ranked:
        assert robot.palm(choice.solution.q) == pytest.approx(
            grasps[choice.candidate].palm, abs=1e-3
        )
    rpy = [0.3, -0.2, 1.0]
    text = "\n".join(f"  {name}: {value!r}" for name, value in grasps[0].posture.items())
    (tmp_path / "palm.yaml").write_text(
        f"palm: {{xyz: [0.4, 0, 0.5], rpy: {rpy}}}\nposture:\n{text}\n"
    )
    loaded = ik.load_grasp(tmp_path / "palm.yaml")
    assert solver.solve(loaded).palm is not None
    far_grasp = grasps[0].at(np.block([[np.eye(3), np.array([[3.0], [0], [0]])], [0, 0, 0, 1.0]]))
    missed = solver.solve(far_grasp)
    assert missed.status is ik.Status.UNREACHABLE
    assert missed.palm is not None
    assert not missed.palm.ok
    assert missed.diagnosis is not None
    assert missed.diagnosis.palm is not None
    assert missed.diagnosis.palm.position_error > 1
    reason_text = reasons(missed)
    assert missed.diagnosis.proof is not None
    assert any("palm" in line for line in reason_text)
    assert not any(finger in line for line in reason_text for finger in (*robot.fingers, "contact"))
    assert far_grasp.palm is not None
    (diagnosis,) = solver.solve_palms(
        far_grasp.palm[None], far_grasp.posture, diagnose=True
    ).diagnoses
    assert diagnosis is not None
    assert diagnosis.palm is not None


def test_many_palms() -> None:
    """Hand postures that differ from row to row stay as they are, in one thread or two."""
    robot = ik.load_robot(KUKA)
    solver = ik.Solver(robot)
    q = robot.random(np.random.default_rng(4), 60)
    motors = robot.description.finger_motors
    columns = [robot.actuators.index(motor) for motor in motors]
    hands = dict(zip(motors, q[:, columns].T, strict=True))
    batch = solver.solve_palms(robot.palm(q), hands)
    assert batch.success.all()
    assert batch.palm_ok is not None
    assert batch.palm_ok.all()
    assert batch.q[:, columns] == pytest.approx(q[:, columns], abs=1e-9)
    parallel_batch = solver.solve_palms(robot.palm(q), hands, jobs=2)
    np.testing.assert_array_equal(parallel_batch.q, batch.q)
    with pytest.raises(ik.CasadiIKError, match=r"postures:.*3\.bh_spread:.*9\.0"):
        solver.solve_palms(robot.palm(q), hands | {"bh_spread": [0.1] * 3 + [9.0] + [0.1] * 56})
    with pytest.raises(ik.CasadiIKError, match=r"postures\.bh_spread:.*60"):
        solver.solve_palms(robot.palm(q), hands | {"bh_spread": [0.1] * 3})


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"palm": np.eye(4)}, "posture: missing"),
        (
            {"palm": np.diag([2.0, 1, 1, 1]), "posture": {"a": 1.0}},
            "palm: the matrix is not a rotation",
        ),
        (
            {
                "palm": np.eye(4),
                "posture": {"a": 1.0},
                "contacts": {"thumb": ik.Contact([0, 0, 1])},
            },
            "palm: is given together with contacts",
        ),
    ],
)
def test_bad_palms(options: dict[str, Any], says: str) -> None:
    with pytest.raises(ik.CasadiIKError, match=says):
        ik.Grasp(**options)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda p: p.pop("bh_spread"), r"posture\.bh_spread: missing"),
        (lambda p: p.update(bh_spred=0.1), r"posture\.bh_spred: no such actuator"),
        (lambda p: p.update(lwr_joint_1=0.1), r"posture\.lwr_joint_1: moves no finger"),
        (lambda p: p.update(bh_spread=9.0), r"posture\.bh_spread: found 9\.0, expected a number"),
    ],
)
def test_bad_postures(change: Any, says: str) -> None:
    robot = ik.load_robot(KUKA)
    posture = dict.fromkeys(robot.description.finger_motors, 0.5)
    change(posture)
    with pytest.raises(ik.CasadiIKError, match=says):
        ik.Solver(robot).solve(ik.Grasp(palm=np.eye(4), posture=posture))


def _table(tmp_path: Path, **changes: Any) -> Path:
    """Write a table of one grasp; None as a change deletes a column."""
    robot = ik.load_robot(KUKA)
    columns: dict[str, Any] = dict.fromkeys(("x", "y", "z", "roll", "pitch", "yaw"), 0.1)
    columns |= dict.fromkeys(robot.description.finger_motors, 0.5)
    columns |= changes
    columns_left = {name: value for name, value in columns.items() if value is not None}
    path = tmp_path / "grasps.csv"
    path.write_text(
        ",".join(columns_left) + "\n" + ",".join(map(str, columns_left.values())) + "\n"
    )
    return path


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"bh_spread": None, "spread": 0.5}, "joint .spread. is unknown; expected"),
        ({"bh_spread": None}, "bh_spread: missing, expected a position"),
        ({"x": 310}, r"position: found 310 m from the object.*numbers in mm\?"),
        ({"bh_spread": 45}, r"joints: found angles beyond two turns.*in degrees\?"),
        ({"bh_spread": 4}, "bh_spread: found 4, expected"),
        ({"y": "nan"}, "row 0: position: holds NaN"),
        ({"y": "abc"}, "row 0: y: found 'abc', expected a number"),
        ({"yaw": None}, "yaw: missing, expected columns x y z"),
    ],
)
def test_bad_tables(changes: dict[str, Any], says: str, tmp_path: Path) -> None:
    with pytest.raises(ik.errors.DescriptionError, match=says) as caught:
        ik.load_candidates(_table(tmp_path, **changes), KUKA)
    assert "\n" not in str(caught.value)
    assert "grasps.csv" in str(caught.value)


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_columns_that_are_not_joints(suffix: str, tmp_path: Path) -> None:
    """A pandas table may have an index, a score, a note, and an empty cell."""
    path = _table(tmp_path)
    head, row = path.read_text().splitlines()
    lines = ["0,{},0.9,good", "1,{},0.8,bad", "2,{},,good"]
    rows = [text.format(row) for text in lines]
    rows[1] = rows[1].replace("0.1", "", 1)
    path.write_text("\n".join([f",{head},Score,label", *rows]) + "\n")
    if suffix == "parquet":
        pl = pytest.importorskip("polars")
        frame = pl.read_csv(path).rename({"": "__index_level_0__"})
        path = path.with_suffix(".parquet")
        frame.write_parquet(path)
    grasps = ik.load_candidates(path, KUKA, invalid="drop")
    assert (grasps.rows, grasps.dropped) == ((0, 2), 1)
    assert grasps[0].posture["bh_spread"] == pytest.approx(0.5)
    with pytest.raises(ik.errors.DescriptionError, match="row 1: position"):
        ik.load_candidates(path, KUKA)


def test_dro_files_are_distinguished_from_multidex(tmp_path: Path) -> None:
    """Rotations are three angles, not the columns of a matrix."""
    row = np.zeros(6 + 8)
    counts = {"num_total": 1, "num_upper_object": 1, "num_per_object": {"contactdb+apple": 1}}
    info = {hand: {"robot_name": hand, **counts} for hand in ("allegro", "barrett")}
    path = tmp_path / "cmap_dataset.pt"
    write_torch(path, {"info": info, "metadata": [(row, "contactdb+apple", "barrett")]})
    with pytest.raises(ik.errors.DescriptionError) as caught:
        ik.load_candidates(path, KUKA, of="contactdb+apple")
    assert all(name in str(caught.value) for name in ("cmap_dataset.pt", "info", "barrett"))


def test_an_empty_set(tmp_path: Path) -> None:
    path = tmp_path / "grasps.csv"
    path.write_text("x,y,z,roll,pitch,yaw\n")
    with pytest.raises(ik.errors.DescriptionError, match="no grasps"):
        ik.load_candidates(path, KUKA)


def _getagrip(**changes: Any) -> dict[str, Any]:
    arrays = {
        "trans": np.zeros((2, 3)),
        "rot": np.tile(np.eye(3), (2, 1, 1)),
        "joint_angles": np.full((2, 16), 0.4),
        "grasp_orientations": np.tile(np.eye(3), (2, 4, 1, 1)),
    }
    return arrays | changes


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (_getagrip(rot=2 * np.tile(np.eye(3), (2, 1, 1))), "row 0: rotation: .* not a rotation"),
        (_getagrip(rot=np.tile(np.diag([1.0, 1, -1]), (2, 1, 1))), "not a rotation"),
        (_getagrip(trans=np.zeros((3, 3))), "rotation: found shape"),
        (_getagrip(joint_angles=np.zeros((2, 12))), "joints: found 12, expected 16"),
        (_getagrip(trans="none"), "trans: expected an array of numbers"),
        (_getagrip(trans=np.zeros((0, 3)), rot=np.zeros((0, 3, 3))), "found no grasps"),
        ({"a": 1}, "its layout is none of getagrip"),
        ([{"qpos": {"WRJTx": 0.0}}], r"row 0: qpos\.WRJTy: missing"),
        ({"robot_pose": np.zeros((2, 3))}, r"robot_pose: found shape \(2, 3\)"),
        ({"grasp_qpos": np.zeros(23)}, "row 0: rotation: holds NaN"),
    ],
)
def test_bad_data_sets(content: Any, says: str, tmp_path: Path) -> None:
    path = tmp_path / "set.npy"
    np.save(path, np.array(content, dtype=object))
    with pytest.raises(ik.errors.DescriptionError, match=says) as caught:
        ik.load_candidates(path, "panda+allegro_right")
    assert "\n" not in str(caught.value)


def test_data_of_another_robot_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "set.npy"
    np.save(path, np.array(_getagrip(), dtype=object))
    with pytest.raises(ik.errors.UnsupportedError, match="getagrip:"):
        ik.load_candidates(path, KUKA)
    with pytest.raises(ik.errors.UnknownNameError, match="layout: found 'mine'"):
        ik.load_candidates(path, KUKA, layout="mine")


SIZES = (0.06, 0.08, 0.1, 0.12, 0.15)


def _dexgraspnet(tmp_path: Path, rows_beyond_limits: int = 0) -> Written:
    """Write a file like the data set: independent distal joints, five sizes of the object."""
    written = made("dexgraspnet_shadow", tmp_path)
    entries, rng = np.load(written.path, allow_pickle=True), np.random.default_rng(1)
    for i, entry in enumerate(entries):
        for finger in ("FF", "MF", "RF", "LF"):
            entry["qpos"] |= {f"robot0:{finger}J{n}": rng.uniform(0, 1.5) for n in (0, 1)}
        entry |= {"scale": SIZES[i % 5], "qpos_st": dict(entry["qpos"]), "energy": 1.0}
        entry["qpos"]["robot0:THJ2"] += 0.5 * (i < rows_beyond_limits)
    np.save(written.path, entries)
    return written


def _tips(robot: ik.ArmHand, grasp: ik.Grasp, postures: np.ndarray) -> np.ndarray:
    """Return fingertips (k, f, 3) in the palm frame of postures (k, m)."""
    q = np.tile(robot.home, (len(postures), 1))
    q[:, [robot.actuators.index(name) for name in grasp.posture]] = postures
    palms = robot.palm(q)
    return (robot.contacts(q)[0] - palms[:, None, :3, 3]) @ palms[:, :3, :3]


def test_free_joints_of_a_data_set(tmp_path: Path) -> None:
    """Distal joints of the Shadow hand follow the middle ones; no posture has nearer fingertips."""
    written = _dexgraspnet(tmp_path)
    robot, rng = written.robot, np.random.default_rng(2)
    grasps = ik.load_candidates(written.path, robot, scale=SIZES[0])
    assert grasps.rows == (0, 5)
    assert grasps.scale == SIZES[0]
    assert grasps[1].name == "dexgraspnet_shadow[5]"
    candidates = ik.load_candidates(written.path, robot, scale=SIZES[0], take="contacts")
    for grasp, contacts, shift in zip(grasps, candidates, grasps.shift, strict=True):
        palm = grasp.palm
        assert palm is not None
        theirs = (contacts.arrays(robot.fingers)[0] - palm[:3, 3]) @ palm[:3, :3]
        posture = np.array(list(grasp.posture.values()))
        (ours,) = _tips(robot, grasp, posture[None])
        off = np.linalg.norm(ours - theirs, axis=1)
        assert shift == pytest.approx(off.max(), abs=1e-6)
        assert shift < 0.02
        around = posture + rng.normal(size=(4000, len(posture))) * rng.choice(
            [0.01, 0.1], (4000, 1)
        )
        columns = [robot.actuators.index(name) for name in grasp.posture]
        tips_nearby = _tips(
            robot, grasp, np.clip(around, robot.lower[columns], robot.upper[columns])
        )
        assert (np.linalg.norm(tips_nearby - theirs, axis=2).min(axis=0) >= off - 2e-5).sum() >= 4
        assert ((tips_nearby - theirs) ** 2).sum(axis=(1, 2)).min() >= (off**2).sum() - 1e-9
    shifts = [shift_norm for shift_norm in grasps.shift if shift_norm > 1e-4]
    assert any("shifted" in note for note in grasps.notes) == bool(shifts)


def test_sizes_of_an_object(tmp_path: Path) -> None:
    written = _dexgraspnet(tmp_path)
    says = r"5 sizes \(scale 0\.06: 2 rows, 0\.08: 1 rows"
    with pytest.raises(ik.errors.DescriptionError, match=says):
        ik.load_candidates(written.path, written.robot)
    with pytest.raises(ik.errors.DescriptionError, match=r"scale:.*0\.07.*5"):
        ik.load_candidates(written.path, written.robot, scale=0.07)
    with pytest.raises(ik.CasadiIKError, match=r"scale: found 1, .*grasps\.csv"):
        ik.load_candidates(_table(tmp_path), KUKA, scale=1.0)
    bodex = made("bodex_shadow", tmp_path)
    assert ik.load_candidates(bodex.path, bodex.robot).scale == pytest.approx(0.06)


def test_rows_beyond_limits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Rows beyond limits are refused, dropped or clipped, and counted."""
    written = _dexgraspnet(tmp_path, rows_beyond_limits=1)
    options = {"path": written.path, "robot": written.robot, "scale": SIZES[0]}
    says = r"row 0: shadow_thj3: found .*; 1 of 2 rows are invalid; invalid='drop'.*'clip'.*--inv"
    with pytest.raises(ik.errors.DescriptionError, match=says) as caught:
        ik.load_candidates(**options)
    assert "\n" not in str(caught.value)
    clipped = ik.load_candidates(**options, invalid="clip")
    assert (len(clipped), clipped.dropped, clipped.clipped) == (2, 0, 1)
    at = written.robot.actuators.index("shadow_thj3")
    assert clipped[0].posture["shadow_thj3"] == written.robot.upper[at]
    assert clipped.shift[0] > 1e-3
    assert "1 of 2 rows" in str(clipped)
    fewer = ik.load_candidates(**options, invalid="drop")
    assert (fewer.rows, fewer.dropped, fewer.clipped) == ((5,), 1, 0)
    assert "1 of 2 rows dropped" in str(fewer)
    written_beyond = _dexgraspnet(tmp_path, rows_beyond_limits=2)
    with pytest.raises(ik.errors.DescriptionError, match=r"1: shadow_thj3: .*; 1.*1"):
        ik.load_candidates(
            written_beyond.path, written_beyond.robot, scale=SIZES[1], invalid="drop"
        )
    with pytest.raises(ik.CasadiIKError, match=r"invalid:.*'no'"):
        ik.load_candidates(**options, invalid="no")  # pyright: ignore[reportArgumentType]
    words = ["choose", str(written.path), "--robot", "ur5e+shadow", "--out", str(tmp_path / "r")]
    assert main([*words, "--scale", "0.06"]) == 2
    assert "--invalid" in capsys.readouterr().err
    assert main([*words, "--scale", "0.06", "--invalid", "clip"]) in (0, 1)
    assert "1 of 2 rows" in capsys.readouterr().out


def test_invalid_rows_can_be_dropped(tmp_path: Path) -> None:
    """Rows with NaN, millimetres, an invalid rotation, or no pad at the object can be left out."""
    arrays, robot = _getagrip(), ik.load_robot("panda+allegro_right")
    wrong = {name: np.repeat(array, 3, axis=0) for name, array in arrays.items()}
    wrong["trans"][1, 0], wrong["trans"][2, 0], wrong["rot"][3] = np.nan, 310.0, 0.0
    path = tmp_path / "set.npy"
    np.save(path, np.array(arrays, dtype=object))
    thumb = ik.load_candidates(path, robot, take="contacts")[0].contacts["thumb"].point
    wrong["trans"][[0, 5]] = [0, 0, load_object("apple").mesh()[0][:, 2].max()] - thumb
    np.save(path, np.array(wrong, dtype=object))
    with pytest.raises(ik.errors.DescriptionError, match=r"1: position:.*NaN.*; 3.*6"):
        ik.load_candidates(path, robot, invalid="clip")
    assert ik.load_candidates(path, robot, invalid="drop").rows == (0, 4, 5)
    wrong["trans"][4] = 0.0, 0.5, 0.0
    np.save(path, np.array(wrong, dtype=object))
    with pytest.raises(ik.errors.DescriptionError, match=r"4.*6.*invalid='drop'"):
        ik.load_candidates(path, robot, take="contacts", grasped="apple")
    assert ik.load_candidates(
        path, robot, invalid="drop", take="contacts", grasped="apple"
    ).rows == (0, 5)


@pytest.mark.parametrize("name", ["bodex_allegro", "dexgraspbench_leap"])
def test_pregrasp_and_squeeze_stages(name: str, tmp_path: Path) -> None:
    """Pregrasp and squeeze stay with the candidate and move with it."""
    written = made(name, tmp_path)
    place = np.eye(4)
    place[:3, 3] = 0.4, 0.1, 0.2
    candidates = ik.load_candidates(written.path, written.robot, object_pose=place)
    robot = written.robot
    for grasp, q in zip(candidates, written.q, strict=True):
        pregrasp, after = grasp.pregrasp, grasp.squeeze
        assert pregrasp is not None
        assert after is not None
        assert after.palm is not None
        for motor, position in pregrasp.posture.items():
            i = robot.actuators.index(motor)
            halves, twice = (
                np.clip(share * q[i], robot.lower[i], robot.upper[i]) for share in (0.5, 2)
            )
            assert position == pytest.approx(halves, abs=1e-6)
            assert after.posture[motor] == pytest.approx(twice, abs=1e-6)
    still = ik.load_candidates(written.path, robot)
    assert candidates[0].pregrasp is not None
    assert still[0].pregrasp is not None
    assert still[0].pregrasp.palm is not None
    assert candidates[0].pregrasp.palm == pytest.approx(place @ still[0].pregrasp.palm)
    restored = pickle.loads(pickle.dumps(candidates[0]))
    assert restored.squeeze.posture == candidates[0].squeeze.posture


class _Runs:
    """A plain unpickler would call the content."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.held = function, arguments

    def __reduce__(self) -> Any:
        return self.held


@pytest.mark.parametrize(
    "build",
    [
        lambda flag: _Runs(os.system, f"touch {flag}"),
        lambda flag: _Runs(open, str(flag), "w"),
        lambda flag: _Runs(eval, f"open({str(flag)!r}, 'w')"),
        lambda flag: _Runs(np.save, str(flag), np.zeros(1)),
        lambda flag: _Runs(np.memmap, str(flag), "u1", "w+", 0, (8,)),
        lambda flag: _Runs(np.ndarray, (2**40,)),
        lambda flag: _Runs(getattr, "a", "upper"),
    ],
)
def test_pickles_execute_nothing(build: Any, tmp_path: Path) -> None:
    path, flag = tmp_path / "set.npy", tmp_path / "flag"
    np.save(path, np.array(_getagrip(trans=build(flag)), dtype=object), allow_pickle=True)
    with pytest.raises(ik.errors.DescriptionError, match=r"set\.npy:"):
        ik.load_candidates(path, "panda+allegro_right")
    assert not flag.exists()


@pytest.mark.parametrize("name", ["getagrip_allegro", "multidex_allegro"])
def test_damaged_pickles(name: str, tmp_path: Path) -> None:
    """Every truncation and many changes of a file give one error line or grasps."""
    written = made(name, tmp_path).path
    pickled, path = written.read_bytes(), tmp_path / f"cut{written.suffix}"
    robot, rng = ik.load_robot("panda+allegro_right"), np.random.default_rng(0)
    begun = pickled.index(pickle.PROTO, 10)
    for trial in range(150):
        data = bytearray(pickled)
        if trial % 3 == 0:
            del data[int(rng.integers(len(data))) :]
        else:
            for place in rng.integers(begun, begun + 700, 3):
                data[place] = int(rng.integers(256))
        path.write_bytes(bytes(data))
        error_text = ""
        try:
            ik.load_candidates(path, robot)
        except ik.CasadiIKError as error:
            error_text = str(error)
        assert "\n" not in error_text
