"""Description files, read as scenes: units, keys, and errors of malformed files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from processes import MODELS
from scipy.spatial.transform import Rotation

import casadi_ik as ik

SOLID = "solids: {{a: {{kind: sphere, radius: 1, {}}}}}"


def pose(tmp_path: Path, text: str) -> np.ndarray:
    path = tmp_path / "file.yaml"
    path.write_text(SOLID.format(text))
    return ik.load_scene(path).items["a"].pose


@pytest.mark.parametrize(
    ("written", "value"),
    [("1.5", 1.5), ("1e2 mm", 0.1), ("+.5 cm", 0.005), ("3 m", 3.0), ("4.", 4.0), ("-20mm", -0.02)],
)
def test_length(tmp_path, written, value):
    assert pose(tmp_path, f"xyz: [0, {written}, 0]")[1, 3] == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize(
    ("written", "value"),
    [("60 deg", np.pi / 3), ("-90deg", -np.pi / 2), ("2 rad", 2.0), ("0.5", 0.5)],
)
def test_frame_is_that_of_urdf(tmp_path, rng, written, value):
    roll, pitch = rng.uniform(-1.5, 1.5, 2).tolist()
    expected = Rotation.from_euler("xyz", [roll, pitch, value]).as_matrix()
    actual = pose(tmp_path, f"rpy: [{roll}, {pitch}, {written}]")
    np.testing.assert_allclose(actual[:3, :3], expected, atol=1e-15)


BAD = {
    "unknown key": ("solid: {}", "(top level)", "solid"),
    "unknown key of an entry": (SOLID.format("radus: 2"), "solids.a", "radus"),
    "unknown unit": (SOLID.format("xyz: [3 furlong, 0, 0]"), "solids.a.xyz[0]", "furlong"),
    "unit of another dimension": (SOLID.format("xyz: [1 kg, 0, 0]"), "solids.a.xyz[0]", "1 kg"),
    "two units": (SOLID.format("xyz: [3 mm mm, 0, 0]"), "solids.a.xyz[0]", "3 mm mm"),
    "no number": ("margin: many", "margin", "many"),
    "wrong type": ("margin: [1]", "margin", "array"),
    "length": (SOLID.format("xyz: [1, 2]"), "solids.a.xyz", "3"),
    "row": ("solids: {b: {kind: convex, points: [[1, 2, x]]}}", "solids.b.points[0][2]", "x"),
    "NaN": ("margin: .nan", "margin", "nan"),
    "infinity": (SOLID.format("xyz: [0, 0, -.inf]"), "solids.a.xyz[2]", "-inf"),
    "key that is a number": ("solids: {1: {}}", "solids", "int"),
    "list at the top": ("[1]", "(top level)", "array"),
    "empty file": ("", "(top level)", "null"),
}


@pytest.mark.parametrize("case", BAD)
def test_error_names_file_and_key(tmp_path, case):
    text, key, value = BAD[case]
    path = tmp_path / "file.yaml"
    path.write_text(text)
    with pytest.raises(ik.errors.DescriptionError) as caught:
        ik.load_scene(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: {key}: ")
    assert value in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("margin: 1\nmargin: 2", ":2:1: .*'margin'"),
        ("solids: {a: {kind: sphere, radius: 1}, a: {}}", ":1:40: .*'a'"),
        ("solids: {[1]: 2}", ":1:10: "),
        # libyaml reports the end of the text at the start of the next line.
        ("solids: {a: [1, 2", ":(1:18|2:1): "),
        ("grasped: 2020-99-99", ": "),
        ("solids: &s [*s]", ": "),
        ("margin: !!python/object:os.system 1", ":1:9: .*os.system"),
        ("a: *b", ":1:4: .*alias"),
    ],
)
def test_not_yaml(tmp_path, text, place):
    path = tmp_path / "file.yaml"
    path.write_text(text)
    with pytest.raises(ik.errors.DescriptionError) as caught:
        ik.load_scene(path)
    message = str(caught.value)
    assert re.match(re.escape(str(path)) + place, message), message
    assert "\n" not in message


def test_unreadable_files(tmp_path):
    (tmp_path / "latin.yaml").write_bytes("grasped: gr\xfc\xdfe".encode("latin-1"))
    for path in (tmp_path, tmp_path / "latin.yaml", tmp_path / "nowhere.yaml"):
        with pytest.raises(ik.errors.DescriptionError) as caught:
            ik.load_scene(path)
        assert str(caught.value).startswith(f"{path}: ")


def test_shipped_names_and_paths(tmp_path):
    """A part is a shipped name, or a file beside the description; names are not guessed."""
    robot = "name: mine\narm: {arm}\nhand: barrett_bh8_280\nfingers: [thumb]\n"
    path, part = tmp_path / "robot.yaml", MODELS / "arms" / "kuka_lwr4.yaml"
    (tmp_path / "part.yaml").write_text(part.read_text(encoding="utf-8"), encoding="utf-8")
    expected = None
    for arm in ("kuka_lwr4", str(part), "part.yaml"):
        path.write_text(robot.format(arm=arm))
        urdf = ik.load_robot(path).urdf()
        assert urdf == (expected or urdf)
        expected = urdf
    with pytest.raises(ik.errors.UnknownNameError, match="'kuka'"):
        ik.load_robot("kuka")
    path.write_text(robot.format(arm="nowhere.yaml"))
    with pytest.raises(ik.errors.DescriptionError, match=r"nowhere\.yaml"):
        ik.load_robot(path)
