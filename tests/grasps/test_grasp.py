"""Contacts, grasps and grasp files: accepted and refused values."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import casadi_ik as ik

GOOD = """\
robot: kuka_lwr_barrett
description: a test
object: {name: cup, pose: {xyz: [0.5, 0, 50 mm], rpy: [0, 0, 90 deg]}}
posture: {bh_spread: 30 deg}
contacts:
  thumb: {point: [0.52, 0.1, 0.6], normal: [0.0, -2.0, 0.0]}
  finger_2: {point: [0.55, 0.02, 0.6]}
"""


def test_contact_normalises_and_freezes() -> None:
    contact = ik.Contact([1, 2, 3], [0, 0, 5])
    np.testing.assert_array_equal(contact.point, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(contact.normal, [0.0, 0.0, 1.0])
    assert ik.Contact([1, 2, 3]).normal is None
    with pytest.raises(ValueError, match="read-only"):
        contact.point[0] = 9.0


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: ik.Contact([0, 0, 0], [0, 0, 0]), "normal: .*not zero"),
        (lambda: ik.Contact([0, np.nan, 0]), "point: .*finite"),
        (lambda: ik.Contact([0, 0, 0], [np.inf, 0, 0]), "normal: .*finite"),
        (lambda: ik.Contact([0, 0]), r"point: found shape \(2,\), expected \(3,\)"),
        (lambda: ik.Contact(np.zeros((3, 1))), r"point: found shape \(3, 1\)"),
        (lambda: ik.Contact([0, 0, 0], [[0, 0, 1]]), r"normal: found shape \(1, 3\)"),
        (lambda: ik.Contact(["a", "b", "c"]), "point: found .*three numbers"),
        (lambda: ik.Contact([[1, 2], [3]]), "point: found .*three numbers"),
        (lambda: ik.Grasp({}), "contacts: found none"),
        (lambda: ik.Grasp({"thumb": ([0, 0, 0], [0, 0, 1])}), "contacts.thumb: found tuple"),  # pyright: ignore[reportArgumentType]
    ],
)
def test_bad_input(make: Callable[[], Any], says: str) -> None:
    with pytest.raises(ik.errors.InputError, match=says):
        make()


def test_arrays_mark_what_is_free() -> None:
    grasp = ik.Grasp({"b": ik.Contact([1, 2, 3], [1, 0, 0]), "a": ik.Contact([4, 5, 6])})
    points, normals = grasp.arrays(("a", "b", "c"))
    np.testing.assert_array_equal(points, [[4, 5, 6], [1, 2, 3], [np.nan] * 3])
    np.testing.assert_array_equal(normals, [[np.nan] * 3, [1, 0, 0], [np.nan] * 3])
    with pytest.raises(ik.errors.InputError, match=r"contacts\.b: .*.*a, c"):
        grasp.arrays(("a", "c"))


def test_contacts_of_a_grasp_cannot_be_changed() -> None:
    contacts = {"a": ik.Contact([4, 5, 6])}
    grasp = ik.Grasp(contacts)
    contacts.clear()
    assert tuple(grasp.contacts) == ("a",)
    with pytest.raises(TypeError):
        grasp.contacts["b"] = ik.Contact([0, 0, 0])  # pyright: ignore[reportIndexIssue]


def test_good_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(GOOD)
    grasp = ik.load_grasp(path)
    assert (grasp.name, grasp.robot, grasp.object) == ("mine", "kuka_lwr_barrett", "cup")
    assert grasp.posture["bh_spread"] == pytest.approx(np.pi / 6)
    assert grasp.object_pose is not None
    expected = np.array([[0, -1, 0, 0.5], [1, 0, 0, 0], [0, 0, 1, 0.05], [0, 0, 0, 1]])
    np.testing.assert_allclose(grasp.object_pose, expected, atol=1e-15)
    np.testing.assert_array_equal(grasp.contacts["thumb"].normal, [0.0, -1.0, 0.0])
    assert grasp.contacts["finger_2"].normal is None
    assert ik.load_grasp(str(path)).contacts.keys() == grasp.contacts.keys()


def test_contacts_alone_suffice(tmp_path: Path) -> None:
    path = tmp_path / "bare.yaml"
    path.write_text("contacts: {thumb: {point: [0, 0, 1]}}\n")
    grasp = ik.load_grasp(path)
    assert (grasp.robot, grasp.object, grasp.object_pose, grasp.posture) == ("", "", None, {})


@pytest.mark.parametrize(
    ("old", "new", "key", "says"),
    [
        ("[0.0, -2.0, 0.0]", "[0, 0, 0]", "contacts.thumb.normal", "not zero"),
        ("[0.52, 0.1, 0.6]", "[0.52, .nan, 0.6]", "contacts.thumb.point", "finite"),
        ("[0.0, -2.0, 0.0]", "[0, .inf, 0]", "contacts.thumb.normal", "finite"),
        ("[0.52, 0.1, 0.6]", "[0.52, 0.1]", "contacts.thumb.point", "length 3"),
        ("[0.52, 0.1, 0.6]", "0.52", "contacts.thumb.point", "`array | null`"),
        ("[0.52, 0.1, 0.6]", "[a, b, c]", "contacts.thumb.point[0]", "`float`"),
        (
            "point: [0.52, 0.1, 0.6], ",
            "",
            "contacts.thumb.point",
            "missing, expected three numbers",
        ),
        ("normal:", "nomral:", "contacts.thumb", "nomral"),
        ("robot:", "robbot:", "(top level)", "robbot"),
        ("contacts:\n", "kontakte:\n", "(top level)", "kontakte"),
        ("name: cup", "nam: cup", "object", "nam"),
        ("xyz: [0.5, 0, 50 mm]", "xyz: [.nan, 0, 0]", "object.pose.xyz", "finite"),
        ("rpy: [0, 0, 90 deg]", "rpy: [0, 0, .inf]", "object.pose.rpy", "finite"),
        ("30 deg", ".nan", "posture.bh_spread", "finite"),
        ("30 deg", "30 degrees", "posture.bh_spread", "unknown unit 'degrees'"),
        ("  finger_2:", "  thumb:", "", "'thumb' appears twice"),
        ("[0.55, 0.02, 0.6]}", "[0.55, 0.02, 0.6}", "", "not valid YAML"),
    ],
)
def test_bad_file(tmp_path: Path, old: str, new: str, key: str, says: str) -> None:
    path = tmp_path / "bad.yaml"
    assert old in GOOD
    path.write_text(GOOD.replace(old, new, 1))
    refused(path, key, says)


@pytest.mark.parametrize(
    ("text", "key", "says"),
    [
        ("robot: kuka_lwr_barrett\n", "contacts", "found none"),
        ("contacts: {}\n", "contacts", "at least one finger"),
        ("", "(top level)", "`null`"),
        ("- 1\n- 2\n", "(top level)", "`array`"),
        ("contacts: {thumb: {point: [0, 0, 1]\n", "", "not valid YAML"),
        ("a: \tb: c\n", "", "not valid YAML"),
    ],
)
def test_hopeless_file_is_refused(tmp_path: Path, text: str, key: str, says: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    refused(path, key, says)


def test_missing_binary_and_unknown(tmp_path: Path) -> None:
    refused(tmp_path / "missing.yaml", "", "no such file")
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x81")
    refused(binary, "", "not UTF-8")
    with pytest.raises(ik.errors.UnknownNameError, match=r"'teacup'.*cup"):
        ik.load_grasp("teacup")


def refused(path: Path, key: str, says: str) -> None:
    """The error names the file, the key and the fault."""
    with pytest.raises(ik.errors.DescriptionError) as caught:
        ik.load_grasp(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert key in message
    assert says in message
    assert "\n" not in message


def test_palms_by_side_are_read_from_a_file(tmp_path):
    file = tmp_path / "both.yaml"
    file.write_text(
        "robot: g1+dex3\nposture: {left_dex3_thumb_0: 0.1}\n"
        "palms: {left: {xyz: [0.3, 0.2, 0.1], rpy: [0, 0, 0]}}\n"
    )
    assert ik.load_grasp(file).palm["left"][:3, 3].tolist() == [0.3, 0.2, 0.1]
    file.write_text(file.read_text() + "palm: {xyz: [0, 0, 0], rpy: [0, 0, 0]}\n")
    with pytest.raises(ik.errors.DescriptionError, match=r"palms: .*palm"):
        ik.load_grasp(file)
