"""`casadi-ik import` and `calibrate`: from the files of a user to a robot that is solved."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from command_line import Command
from imported_files import joint, link, urdf

import casadi_ik as ik

PHALANX = """<collision><origin xyz="0 0 {middle}"/><geometry>
<box size="0.02 0.016 {length}"/></geometry></collision>"""


def moves(
    name: str, parent: str, child: str, xyz: str, axis: str, limits: str, **attributes: str
) -> str:
    """Return a joint between limits, or a continuous one."""
    low, high = limits.split() if limits else ("", "")
    attributes |= {"limit": f'lower="{low}" upper="{high}" velocity="0" effort="1"'}
    return joint(name, parent, child, xyz=xyz, axis=axis, **attributes)


def hand(folder: Path, shapes: bool = True) -> Path:
    """Write two fingers at y = -40 mm that bend to +y, and one at +40 mm that bends to -y."""
    end = PHALANX.format(middle=0.02, length=0.04) if shapes else ""
    text = link("palm")
    for name, x, side in (("ff", -0.03, -1), ("mf", 0.03, -1), ("opposed", 0.0, 1)):
        place, axis = f"{x} {0.04 * side} 0.05", f"{side} 0 0"
        text += link(f"{name}_1") + link(f"{name}_2") + link(f"{name}_3", content=end)
        text += moves(f"{name}_a", "palm", f"{name}_1", place, "0 1 0", "-0.3 0.3")
        text += moves(f"{name}_b", f"{name}_1", f"{name}_2", "0 0 0.01", axis, "-0.1 1.4")
        text += moves(f"{name}_c", f"{name}_2", f"{name}_3", "0 0 0.04", axis, "0 1.5")
    return urdf(folder / "hand.urdf", text)


def arm(folder: Path) -> Path:
    """Write an arm of six joints, the last one continuous, with a fixed flange."""
    text = link("base", *(f"l{i}" for i in range(6)), "tool_flange")
    links = ["base", *(f"l{i}" for i in range(6))]
    for i, axis in enumerate(("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")):
        step = ("0 0 0.3", "0.05 0 0.1", "0 0 0.35", "0.3 0 0.05", "0.1 0 0", "0.08 0 0")[i]
        kind = "continuous" if i == 5 else "revolute"
        text += moves(f"j{i}", links[i], links[i + 1], step, axis, "-2.5 2.5", kind=kind)
    text += moves(
        "f", "l5", "tool_flange", "0.05 0 0", "0 0 1", "0 0", kind="fixed", rpy="0 1.57 0"
    )
    return urdf(folder / "arm.urdf", text)


@pytest.mark.slow
def test_import_and_solve(run_process: Command, tmp_path: Path, rng: np.random.Generator) -> None:
    pytest.importorskip("pinocchio")
    arm(tmp_path)
    hand(tmp_path)
    done = run_process("import", "arm.urdf", "hand.urdf", "--out", "mine.yaml", "--check").fine()
    words = done.out.split()
    for word in ("IMPORTED", "tool_flange:", "15", "GUESS:", "reference", "mine.yaml"):
        assert word in words, done.out
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "arm.urdf",
        "hand.urdf",
        "mine.yaml",
    ]
    robot = ik.load_robot(tmp_path / "mine.yaml")
    # The file names two fingers; the third one bends against them.
    assert robot.fingers == ("thumb", "index", "middle")
    assert robot.thumb == "thumb"
    assert (np.abs(robot.home - (robot.lower + robot.upper) / 2) < np.pi / 2 + 0.01).all()
    points, normals = robot.contacts(robot.random(rng, 1)[0])
    contacts = {
        name: {"point": points[i].tolist(), "normal": normals[i].tolist()}
        for i, name in enumerate(robot.fingers)
    }
    grasp = {"robot": "mine.yaml", "contacts": contacts}
    (tmp_path / "grasp.yaml").write_text(yaml.safe_dump(grasp))
    solved = run_process("solve", "grasp.yaml", "--out", "solved.json")
    assert solved.exit == 0, solved
    assert "SOLVED" in solved.out


def test_closed_form_is_reported_and_its_absence_warned_about(run: Command, tmp_path: Path) -> None:
    path, out = arm(tmp_path), tmp_path / "mine.yaml"
    done = run("import", path, hand(tmp_path), "--out", out).fine()
    assert "spherical wrist" in done.out
    assert "no known closed form" not in done.out
    out.unlink()
    # With the last two axes displaced, no two of the last three axes intersect.
    offset_text = (
        path.read_text().replace("0.08 0 0", "0.08 0 0.06").replace("0.1 0 0", "0.1 0 0.05")
    )
    path.write_text(offset_text)
    done = run("import", path, hand(tmp_path), "--out", out).fine()
    assert "no known closed form" in " ".join(done.out.split())


def test_guessed_pads_are_on_the_skin_of_the_closing_side(run: Command, tmp_path: Path) -> None:
    run("import", hand(tmp_path), "--out", tmp_path / "mine.yaml").fine()
    text = (tmp_path / "mine.yaml").read_text()
    data = yaml.safe_load(text)
    assert text.count("GUESS") >= 5
    assert data["hand"] == data["hand"] | {"file": "hand.urdf"}
    assert data["hand"]["palm"]["link"] == "palm"
    for name, side in (("thumb", -1), ("index", 1), ("middle", 1)):
        pad = data["fingers"][name]
        np.testing.assert_allclose(pad["normal"], [0, side, 0], atol=1e-6)
        # The box is 16 mm thick and 40 mm long: the pad is 8 mm from its end, in the middle of its
        # side.
        np.testing.assert_allclose(pad["xyz"], [0, side * 0.008, 0.032], atol=1e-6)


def test_without_shapes_the_pad_is_guessed_from_the_joints(run: Command, tmp_path: Path) -> None:
    done = run("import", hand(tmp_path, shapes=False), "--out", tmp_path / "mine.yaml")
    assert done.exit == 0
    data = yaml.safe_load((tmp_path / "mine.yaml").read_text())
    np.testing.assert_allclose(data["fingers"]["index"]["normal"], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(data["fingers"]["index"]["xyz"], [0, 0, 0.032], atol=1e-6)
    assert "without shapes" in (tmp_path / "mine.yaml").read_text()


def test_options_override_guesses(run: Command, tmp_path: Path) -> None:
    words = ("--tip", "l5", "--palm", "palm", "--mount", "0.01", "0", "-0.02", "0", "0.5", "0")
    out = tmp_path / "mine.yaml"
    assert run("import", arm(tmp_path), hand(tmp_path), *words, "--out", out).exit == 0
    data = yaml.safe_load(out.read_text())
    assert data["arm"]["tip"] == "l5"
    assert data["mount"] == {"xyz": [0.01, 0, -0.02], "rpy": [0, 0.5, 0]}


def humanoid(folder: Path, robot: ik.ArmHand) -> Path:
    """Write the file of a multi-arm robot with an additional leg and a head."""
    text = robot.urdf().replace("</robot>", "")
    for name, kind in (("leg", "-1 -0.2"), ("head", "-0.5 0.5")):
        text += link(name) + moves(name, robot.description.root, name, "0 0 1", "0 1 0", kind)
    path = folder / "humanoid.urdf"
    path.write_text(text + "</robot>")
    return path


@pytest.mark.slow
def test_trunk_and_sides_of_a_humanoid_are_detected(
    run: Command, tmp_path: Path, rng: np.random.Generator
) -> None:
    pytest.importorskip("pinocchio")
    shipped, out = ik.load_robot("g1+dex3"), tmp_path / "mine.yaml"
    done = run("import", humanoid(tmp_path, shipped), "--out", out, "--check").fine()
    text = " ".join(done.out.split())
    for words in (
        "31 motors (3 trunk; left 7 arm, 7 hand; right 7 arm, 7 hand), 6 fingers",
        "trunk torso_link: last link that carries all palms",
        "locked leg, head: moves no palm",
        "equal to the reference library",
    ):
        assert words in text, done.out
    robot = ik.load_robot(out)
    assert robot.description.trunk == shipped.description.trunk
    for ours, shipped_side in zip(robot.description.sides, shipped.description.sides, strict=True):
        assert (ours.name, ours.arm, set(ours.hand)) == (
            shipped_side.name,
            shipped_side.arm,
            set(shipped_side.hand),
        )
        assert set(ours.fingers) == set(shipped_side.fingers)
    assert yaml.safe_load(out.read_text())["robot"]["locked"] == {"leg": -0.2, "head": 0}
    targets = [robot.contacts(q) for q in robot.random(rng, 20)]
    points, normals = (np.array(rows) for rows in zip(*targets, strict=True))
    assert ik.Solver(robot).solve_batch(points, normals).success.all()


@pytest.mark.slow
def test_palms_of_a_body_can_be_named(run: Command, tmp_path: Path) -> None:
    robot = ik.load_robot("g1+dex3")
    path, out = humanoid(tmp_path, robot), tmp_path / "mine.yaml"
    palms = tuple(side.palm_link for side in robot.description.sides)
    run("import", path, "--palm", *palms, "--out", out).fine()
    sides = yaml.safe_load(out.read_text())["sides"]
    assert tuple(side["palm"]["link"] for side in sides.values()) == palms
    for words, says in (
        ((palms[0], palms[0]), f"--palm: {palms[0]!r} is given twice"),
        (("torso_link", palms[0]), "--palm: 'torso_link' carries another palm"),
        ((*palms, "hip"), "--palm: humanoid.urdf has no link 'hip'"),
        ((palms * 3), "--palm: found 6 links, expected at most 4"),
    ):
        refused = run("import", path, "--palm", *words, "--out", tmp_path / "other.yaml")
        assert says in refused.error
    name = '<joint name="right_elbow_joint" type="revolute">'
    path.write_text(path.read_text().replace(name, f'{name}<mimic joint="left_elbow_joint"/>'))
    other_file = tmp_path / "other.yaml"
    error = run("import", path, "--palm", *palms, "--out", other_file).error
    assert error.startswith(f"{other_file}: sides.right: joint 'right_elbow_joint' follows motor ")
    assert not list(tmp_path.glob("*other*"))


def test_joints_without_limits_get_assumed_ones(run: Command, tmp_path: Path) -> None:
    path = hand(tmp_path)
    limit = '<limit lower="-0.3" upper="0.3" velocity="0" effort="1"/>'
    path.write_text(path.read_text().replace(limit, ""))
    done = run("import", path, "--out", tmp_path / "mine.yaml")
    assert done.exit == 0
    data = yaml.safe_load((tmp_path / "mine.yaml").read_text())
    assert data["hand"]["limits"]["ff_a"] == [-3.14159, 3.14159]
    assert "ff_a" in done.out


def test_palm_with_arms_as_fingers_is_warned_about(run: Command, tmp_path: Path) -> None:
    path = arm(tmp_path)
    leg = link("leg") + moves("hip", "base", "leg", "0.1 0 0", "0 1 0", "-1 1")
    path.write_text(path.read_text().replace("</robot>", f"{leg}</robot>"))
    done = run("import", path, "--palm", "base", "--out", tmp_path / "mine.yaml").fine()
    assert re.search("--palm: .*'base' of arm.urdf", done.out)


def chain(folder: Path, names: Sequence[str], root: str = "base") -> str:
    """Return links and joints of a serial arm with distances of 0.1 m."""
    text, parent = "", root
    for i, name in enumerate(names):
        axis = ("0 0 1", "0 1 0", "0 1 0", "1 0 0")[i % 4]
        text += link(f"{name}_link")
        text += moves(name, parent, f"{name}_link", "0 0 0.1", axis, "-2 2")
        parent = f"{name}_link"
    return text


ARM = ("pan", "lift", "elbow", "wrist_flex", "wrist_roll")


@pytest.mark.parametrize(
    ("last", "motors", "fingers"),
    [
        ("gripper", (5, 1), ("moving_jaw", "fixed_jaw")),
        ("wrist_yaw", (6, 0), ("tool",)),
    ],
)
def test_single_chain_is_an_arm_with_jaw_or_tool(
    run: Command, tmp_path: Path, last: str, motors: tuple[int, int], fingers: tuple[str, ...]
) -> None:
    path = urdf(tmp_path / "so.urdf", link("base"), chain(tmp_path, (*ARM, last)))
    out = tmp_path / "mine.yaml"
    run("import", path, "--out", out).fine()
    robot = ik.load_robot(out)
    arm_motors = len(robot.description.arm_actuators)
    assert (arm_motors, len(robot.actuators) - arm_motors) == motors
    assert robot.fingers == fingers


def test_fixed_jaw_faces_the_moving_jaw(run: Command, tmp_path: Path) -> None:
    def box(at: str, size: str) -> str:
        origin = f'<origin xyz="{at}"/>'
        return f'<collision>{origin}<geometry><box size="{size}"/></geometry></collision>'

    text = link("base") + chain(tmp_path, ARM[:4])
    text += link("roll", content=box("0 -0.03 0.05", "0.02 0.01 0.1"))
    text += moves("wrist_roll", "wrist_flex_link", "roll", "0 0 0.1", "0 0 1", "-2 2")
    text += link("end", content=box("0 0 0.04", "0.02 0.01 0.08"))
    text += moves("j", "roll", "end", "0 0.03 0.02", "1 0 0", "0 1")
    path, out = urdf(tmp_path / "so.urdf", text), tmp_path / "mine.yaml"
    run("import", path, "--palm", "roll", "--out", out).fine()
    fingers = yaml.safe_load(out.read_text())["fingers"]
    assert set(fingers) == {"moving_jaw", "fixed_jaw"}
    assert fingers["fixed_jaw"]["link"] == "roll"
    np.testing.assert_allclose(fingers["moving_jaw"]["normal"], [0, -1, 0], atol=1e-6)
    assert fingers["fixed_jaw"]["xyz"][1] == pytest.approx(-0.025)
    assert fingers["fixed_jaw"]["normal"][1] > 0.8


def test_two_arms_without_hands_are_the_sides_of_a_body(run: Command, tmp_path: Path) -> None:
    text = link("base")
    for side in ("left", "right"):
        text += chain(tmp_path, [f"{side}_{name}" for name in (*ARM, "wrist_yaw")])
    path, out = urdf(tmp_path / "two.urdf", text), tmp_path / "mine.yaml"
    run("import", path, "--out", out).fine()
    sides = ik.load_robot(out).description.sides
    assert [(side.name, len(side.arm), len(side.hand)) for side in sides] == [
        ("left", 6, 0),
        ("right", 6, 0),
    ]


def test_wheels_head_and_legs_are_not_fingers(run: Command, tmp_path: Path) -> None:
    """An arm with a gripper on a mobile base: two wheels, a head, and a leg as long as an arm."""
    text = link("base", "left_wheel", "right_wheel") + chain(tmp_path, ("head_pan", "head_tilt"))
    for side in ("left", "right"):
        text += moves(side, "base", f"{side}_wheel", "0 0 0", "0 1 0", "", kind="continuous")
    text += chain(tmp_path, [f"leg_{i}" for i in range(6)])
    text += chain(tmp_path, (*ARM, "wrist_yaw"))
    for side in ("l", "r"):
        text += chain(tmp_path, (f"{side}_finger",), "wrist_yaw_link")
    path, out = urdf(tmp_path / "mobile.urdf", text), tmp_path / "mine.yaml"
    run("import", path, "--out", out).fine()
    robot = ik.load_robot(out)
    assert (len(robot.description.arm_actuators), len(robot.actuators)) == (6, 8)
    assert len(robot.fingers) == 2


def test_two_hands_on_wrists_in_one_file_are_two_sides(run: Command, tmp_path: Path) -> None:
    text = link("base")
    for side in ("left", "right"):
        text += chain(tmp_path, (f"{side}_wrist",))
        for finger in ("thumb", "index", "ring"):
            names = [f"{side}_{finger}_{i}" for i in range(4)]
            text += chain(tmp_path, names, f"{side}_wrist_link").replace("0 0 0.1", "0 0 0.03")
    path, out = urdf(tmp_path / "hands.urdf", text), tmp_path / "mine.yaml"
    done = run("import", path, "--out", out).fine()
    sides = ik.load_robot(out).description.sides
    assert [(side.name, len(side.arm), len(side.hand)) for side in sides] == [
        ("left", 1, 12),
        ("right", 1, 12),
    ]
    assert all(len(side.fingers) == 3 for side in sides), done.out


REFUSALS = {
    "no file": (("nothing.urdf",), "nothing.urdf: cannot be read: No such file"),
    "no such palm": (("hand.urdf", "--palm", "hip"), "--palm: hand.urdf has no link 'hip'"),
    "no such tip": (("arm.urdf", "hand.urdf", "--tip", "x"), "--tip: arm.urdf has no link 'x'"),
    "mount of three": (("arm.urdf", "hand.urdf", "--mount", "1", "2", "3"), "found 3 numbers"),
    "mount without arm": (("hand.urdf", "--mount", *"123456"), "--mount: "),
    "an arm for a hand": (("arm.urdf", "hand.urdf", "--palm", "mf_3"), "no joint moves below"),
    "one file twice": (("arm.urdf", "arm.urdf"), "arm.urdf: arm and hand are the same file"),
    "arm that branches": (("two.urdf", "hand.urdf"), "--tip: missing; two.urdf branches at 'base'"),
    "description": (("hand.yaml",), "file is a description; expected --picture"),
    "output is the input": (("hand.urdf", "--out", "hand.urdf"), "expected a name ending in .yaml"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_refused_import_leaves_no_files(
    run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    words, says = REFUSALS[case]
    monkeypatch.chdir(tmp_path)
    hand(tmp_path)
    body = arm(tmp_path).read_text().partition('<link name="l0"/>')[2].removesuffix("</robot>\n")
    other_text = (
        f'<link name="l0"/>{body}'.replace('"l', '"m').replace('"j', '"k').replace('"f"', '"g"')
    )
    body = f'<link name="base"/><link name="l0"/>{body}{other_text.replace("tool_", "tool2_")}'
    Path("two.urdf").write_text(f'<robot name="two">{body}</robot>')
    files_before = sorted(tmp_path.iterdir())
    error = run("import", "--out", "mine.yaml", *words).error
    assert says in error
    assert sorted(tmp_path.iterdir()) == files_before


@pytest.mark.opengl
def test_picture(run: Command, tmp_path: Path) -> None:
    out, picture = tmp_path / "mine.yaml", tmp_path / "mine.png"
    run("import", hand(tmp_path), "--out", out, "--picture", picture).fine()
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "hand.urdf",
        "mine.png",
        "mine.yaml",
    ]


def gripper(folder: Path) -> Path:
    """Write an arm whose gripper has a continuous propeller beside two jaws with one motor."""
    path = arm(folder)
    text = path.read_text().replace("</robot>", "")
    body = '<collision><geometry><mesh filename="{}"/></geometry></collision>'
    text += link("bar") + link("propeller", content=body.format("package://jaws/meshes/none.stl"))
    text += moves("bar", "tool_flange", "bar", "0.04 0 0", "0 0 1", "0 0", kind="fixed")
    text += moves("gripper", "tool_flange", "propeller", "0.02 0 0", "1 0 0", "", kind="continuous")
    mimic = '<mimic joint="left" multiplier="-1"/></joint>'
    for side, mesh in (("left", "meshes/jaw.stl"), ("right", "package://jaws/meshes/jaw.stl")):
        text += link(f"{side}_jaw", content=body.format(mesh))
        ends = "0.015 0.037" if side == "left" else "-0.037 -0.015"
        jaw = moves(side, "bar", f"{side}_jaw", "0 0 0", "0 1 0", ends)
        jaw = jaw.replace("revolute", "prismatic")
        text += jaw if side == "left" else jaw.replace("</joint>", mimic)
    path.write_text(text + "</robot>")
    return path


def test_relative_meshes_are_found_and_a_propeller_is_not_a_thumb(
    run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pinocchio")
    (tmp_path / "jaws" / "meshes").mkdir(parents=True)
    trimesh.creation.box((0.05, 0.01, 0.02)).export(tmp_path / "jaws" / "meshes" / "jaw.stl")
    gripper(tmp_path / "jaws").rename(tmp_path / "jaws" / "robot.urdf")
    monkeypatch.chdir(tmp_path)
    done = run(
        "import", "jaws/robot.urdf", "--palm", "tool_flange", "--out", "mine.yaml", "--check"
    ).fine()
    output = " ".join(done.out.split())
    assert "'package://jaws/meshes/none.stl'" in output
    assert "locked gripper: continuous joint" in output
    robot, text = ik.load_robot("mine.yaml"), Path("mine.yaml").read_text()
    assert len(robot.fingers) == 2
    assert robot.actuators == ("j0", "j1", "j2", "j3", "j4", "j5", "left")
    assert "    gripper: 0  # continuous joint" in text
    points, _ = robot.contacts(robot.home)  # on the jaws' inner sides, which meshes tell
    assert np.linalg.norm(points[0] - points[1]) == pytest.approx(2 * (robot.home[-1] - 0.005))
    # The comment permits deleting these lines.
    assert "delete its line under `fingers`" in text
    lines = text.splitlines(keepends=True)
    remaining_lines = [x for x in lines if not x.startswith(("thumb:", f"  {robot.thumb}: {{link"))]
    assert len(remaining_lines) == len(lines) - 2
    Path("mine.yaml").write_text("".join(remaining_lines))
    assert ik.load_robot("mine.yaml").fingers == robot.fingers[1:]


def test_missing_package_is_reported_once(run: Command, tmp_path: Path) -> None:
    path, text = hand(tmp_path), hand(tmp_path).read_text()
    for name in ("ff_1", "mf_1", "opposed_1"):
        mesh = f'<mesh filename="package://shapes_of_it/meshes/{name}.stl"/>'
        shape = f"<collision><geometry>{mesh}</geometry></collision>"
        text = text.replace(link(name), link(name, content=shape))
    path.write_text(text)
    done = run("import", path, "--out", tmp_path / "mine.yaml")
    assert done.out.count("package 'shapes_of_it' is not found") == 1
    output = " ".join(done.out.split())
    assert "3 meshes" in output
    assert "package://shapes_of_it/meshes/ff_1.stl" in output
    assert "ROS_PACKAGE_PATH=FOLDER casadi-ik import" in output


HEADER = "finger,index_proximal_slider,index_middle_slider,x,y,z,qw,qx,qy,qz\n"
ROW = "index,0.0485,0.0512,-0.0466,0.0921,0.1607,0.0831,0.7023,-0.0829,0.7021\n"


@pytest.fixture
def refused(run: Command, tmp_path: Path) -> Callable[..., str]:
    """Function that calls `calibrate`, returns its refusal, and checks that no file is written."""

    def call(path: Path, *words: Any, out: str = "out.yaml", robot: str = "ar10") -> str:
        files_before = sorted(tmp_path.rglob("*"))
        error = run("calibrate", path, "--robot", robot, "--out", tmp_path / out, *words).error
        assert sorted(tmp_path.rglob("*")) == files_before
        return error

    return call


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    """Forty measured points of a finger with a few outliers."""
    robot, rng = ik.load_robot("ar10"), np.random.default_rng(1)
    q = robot.random(rng, 40)
    points = robot.contacts(q)[0][:, robot.fingers.index("index")] + rng.normal(0, 2e-4, (40, 3))
    points[::20] += 5e-3
    motors = ("index_proximal_slider", "index_middle_slider")
    values = np.hstack([q[:, [robot.actuators.index(name) for name in motors]], points])
    lines = [f"index,{','.join(map(repr, row))}" for row in values.tolist()]
    path = tmp_path / "poses.csv"
    path.write_text("\n".join([f"finger,{','.join(motors)},x,y,z", *lines, ""]))
    return path


@pytest.mark.slow
def test_calibrate_in_a_process(run_process: Command, poses: Path, tmp_path: Path) -> None:
    out = tmp_path / "my_ar10.yaml"
    done = run_process("calibrate", poses, "--robot", "ar10", "--out", out)
    assert done.exit == 0, done.err
    assert done.out.startswith("ESTIMATED  33 numbers from 40 poses")
    assert "index_proximal.b" in done.out
    robot = ik.load_robot(out)
    assert robot.actuators == ik.load_robot("ar10").actuators
    assert not list(tmp_path.glob(".*"))


def test_a_group_of_numbers(run: Command, poses: Path, tmp_path: Path) -> None:
    out = tmp_path / "tips.yaml"
    done = run("calibrate", poses, "--robot", "ar10", "--estimate", "tips", "--out", out)
    assert done.exit == 0, done.err
    assert "6 numbers" in done.out
    assert "index_proximal.b" not in done.out


@pytest.mark.parametrize(
    ("text", "fragment"),
    [
        ("", "holds no measurements"),
        (HEADER, "holds no measurements"),
        (HEADER.replace(",x,", ",X,") + ROW, ":1: column 'X' is unknown; expected finger, x"),
        (HEADER.replace("finger,", "") + ROW, ":1: column 'finger' is missing"),
        (HEADER.replace(",y,", ",x,") + ROW, ":1: column 'x' appears twice"),
        (HEADER.replace(",qz", "") + ROW, ":1: found qw, qx, qy, expected all or none"),
        ("finger,index_proximal_slider,x,y,z\nindex,0.05,0,0,0\n", ":1: column 'index_middle_s"),
        (HEADER + ROW + ROW.replace("index", "toe", 1), ":3: finger: found 'toe', expected one of"),
        (HEADER + ROW + ROW.replace("0.0485", "0.5"), ":3: index_proximal_slider: found 0.5, exp"),
        (HEADER + ROW + "\n" + ROW.replace("0.0921", "a"), ":4: y: found 'a', expected a finite"),
        (HEADER + ROW.replace("0.0921", "nan"), ":2: y: found 'nan', expected a finite number"),
        (HEADER + ROW.replace("0.0921", ""), ":2: y: found '', expected a finite number"),
        (HEADER + ROW.replace("0.0921,", ""), ":2: found 9 columns, expected 10"),
        (HEADER + ROW.replace("0.7021", "0.9"), ":2: qw..qz"),
        (HEADER + ROW.replace("0.7021", ""), ":2: qz: found '', expected a finite number"),
    ],
)
def test_bad_csv(text: str, fragment: str, refused: Callable[..., str], tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    error = refused(path)
    assert error.startswith(f"{path}:")
    assert fragment in error


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Modules with the layout of robot_descriptions, with local files."""
    folder = tmp_path / "site" / "robot_descriptions"
    folder.mkdir(parents=True)
    (folder / "__init__.py").touch()
    (folder / "jaws_description.py").write_text(f"URDF_PATH = {str(gripper(tmp_path))!r}\n")
    (folder / "far_description.py").write_text("raise OSError('no route\\nto host')\n")
    monkeypatch.syspath_prepend(folder.parent)
    return folder


def test_names_of_robot_descriptions(run: Command, tmp_path: Path, package: Path) -> None:
    out = tmp_path / "mine.yaml"
    for name in ("none_description", "far_description"):
        assert name in run("import", name, "--out", out).error
    run("import", "jaws_description", "--out", out).fine()
    assert len(ik.load_robot(out).fingers) == 2
