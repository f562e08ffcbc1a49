"""Description files: units, keys, and errors of malformed files."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import casadi_ik as ik
from casadi_ik.files.reading import (
    UNITS,
    Frame,
    Struct,
    Vector,
    frame_matrix,
    read,
)
from casadi_ik.files.shipped import models_folder, resolve_description


class Entry(Struct, frozen=True):
    """File with values of every type."""

    number: float = 0.0
    text: str = ""
    named: dict[str, float] = {}  # noqa: RUF012
    deep: dict[str, dict[str, Vector]] = {}  # noqa: RUF012
    rows: list[Vector] = []  # noqa: RUF012


def entry(tmp_path: Path, text: str) -> Entry:
    path = tmp_path / "file.yaml"
    path.write_text(text)
    return read(path, Entry)[0]


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("1.5", 1.5),
        ("180 deg", np.pi),
        ("-90deg", -np.pi / 2),
        ("1e2 mm", 0.1),
        ("+.5 cm", 0.005),
        ("360 deg/s", 2 * np.pi),
        ("20 mm/s", 0.02),
        ("2 rad", 2.0),
        ("3 m", 3.0),
        ("4.", 4.0),
        ("55 kg", 55.0),
        ("2 rad/s", 2.0),
        ("2 m/s", 2.0),
    ],
)
def test_quantity(tmp_path, written, value):
    assert entry(tmp_path, f"number: {written}").number == pytest.approx(value, rel=1e-15)


def test_other_text_is_not_a_quantity(tmp_path):
    assert entry(tmp_path, "text: 2 rings and a nut").text == "2 rings and a nut"


BAD = {
    "unknown key": ("numbr: 1", "(top level)", "numbr"),
    "unknown unit": ("number: 3 furlong", "number", "unknown unit 'furlong'; known: rad, deg"),
    "two units": ("number: 3 mm mm", "number", "'3 mm mm'"),
    "no number": ("number: many", "number", "'many', expected `float`, got `str`"),
    "wrong type": ("number: [1]", "number", "expected `float`, got `array`"),
    "named value": ("named: {a: 1, b: x, c: 1}", "named.b", "'x'"),
    "deep value": ("deep: {a: {x: [1, 2, 3]}, b: {y: [1, 2]}}", "deep.b.y", "length 3"),
    "row": ("rows: [[1, 2, 3], [1, 2, x]]", "rows[1][2]", "'x'"),
    "NaN": ("number: .nan", "number", "finite"),
    "infinity": ("rows: [[1, 2, 3], [1, -.inf, 3]]", "rows[1][1]", "finite"),
    "named NaN": ("deep: {a: {x: [1, .nan, 3]}}", "deep.a.x[1]", "finite"),
    "key that is a number": ("named: {1: 2}", "named", "keys"),
    "list at the top": ("[1]", "(top level)", "expected `object`, got `array`"),
    "empty file": ("", "(top level)", "got `null`"),
}


@pytest.mark.parametrize("case", BAD)
def test_error_names_file_and_key(tmp_path, case):
    text, key, says = BAD[case]
    with pytest.raises(ik.errors.DescriptionError) as caught:
        entry(tmp_path, text)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'file.yaml'}: {key}: ")
    assert says in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("number: 1\nnumber: 2", ":2:1: not valid YAML: key 'number' appears twice"),
        ("named: {a: 1, a: 2}", ":1:15: not valid YAML: key 'a' appears twice"),
        ("named: {[1]: 2}", ":1:9: not valid YAML: found unhashable key"),
        # libyaml reports the end of the text at the start of the next line.
        ("rows: [1, 2", ":(1:12|2:1): not valid YAML: .*expected ',' or '\\]'"),
        ("text: 2020-99-99", ": not valid YAML: month must be in 1..12"),
        ("rows: &rows [*rows]", ": nested too deeply"),
        ("number: !!python/object:os.system 1", ":1:9: not valid YAML: could not determine"),
        ("a: *b", ":1:4: not valid YAML: found undefined alias"),
    ],
)
def test_not_yaml(tmp_path, text, says):
    with pytest.raises(ik.errors.DescriptionError) as caught:
        entry(tmp_path, text)
    message = str(caught.value)
    assert re.match(re.escape(str(tmp_path / "file.yaml")) + says, message), message
    assert "\n" not in message


def test_unreadable_files(tmp_path):
    with pytest.raises(ik.errors.DescriptionError, match="cannot be read"):
        read(tmp_path, Entry)
    (tmp_path / "latin.yaml").write_bytes("text: gr\xfc\xdfe".encode("latin-1"))
    with pytest.raises(
        ik.errors.DescriptionError, match=r"latin\.yaml: cannot be read: not UTF-8 text"
    ):
        read(tmp_path / "latin.yaml", Entry)


def test_every_unit_is_understood(tmp_path):
    for unit, factor in UNITS.items():
        assert entry(tmp_path, f"number: 2 {unit}").number == 2 * factor


def test_frame_is_that_of_urdf(rng):
    for _ in range(20):
        rpy = rng.uniform(-np.pi, np.pi, 3)
        xyz = rng.normal(size=3)
        pose = frame_matrix(Frame(tuple(xyz), tuple(rpy)))
        expected = pin.SE3(pin.rpy.rpyToMatrix(rpy), xyz).homogeneous
        np.testing.assert_allclose(pose, expected, atol=1e-15)


def test_shipped_names_and_paths(tmp_path):
    assert "kuka_lwr_barrett" in ik.shipped_names("arm_hands")
    assert resolve_description("kuka_lwr4", "arms") == models_folder() / "arms" / "kuka_lwr4.yaml"
    (tmp_path / "part.yaml").write_text("")
    assert (
        resolve_description("part.yaml", "arms", relative_to=tmp_path / "robot.yaml")
        == tmp_path / "part.yaml"
    )
    assert resolve_description(tmp_path / "part.yaml", "arms") == tmp_path / "part.yaml"
    with pytest.raises(ik.errors.UnknownNameError, match=r"'kuka'; shipped: "):
        resolve_description("kuka", "arm_hands")
    with pytest.raises(ik.errors.DescriptionError, match=r"nowhere\.yaml:"):
        resolve_description(str(tmp_path / "nowhere.yaml"), "arms")
