"""Hostile files give one short line within a bounded time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from processes import POSIX

import casadi_ik as ik

ROBOT = "kuka_lwr_barrett"
CONTACT = "contacts: {thumb: {point: [0, 0, 0]}}\n"

HOSTILE = {
    "bomb": (
        "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
        + "".join(
            f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n"
            for a, b in zip("abcdefgh", "bcdefghi", strict=True)
        ),
        "holds more than 200000 values",
    ),
    "brackets": ("a: " + "[" * 200_000, "nest"),
    "braces": ("{a: " * 200_000, "nest"),
    "merge": ("b: &b {x: 1}\na: {<<: *b}\n", "merge keys (<<)"),
    "size": ("a: [" + "1, " * 2_000_000 + "1]", "is larger than 4 MiB"),
    "number": ("a: " + "1" * 20_000, "10000 characters"),
    "sixties": ("a: " + ":".join(["1"] * 6000), "10000 characters"),
    "escape": ('a: "\\e[2J"', "control characters"),
    "itself": ("a: &a [*a]", "nested too deeply"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_yaml(tmp_path: Path, case: str) -> None:
    text, says = HOSTILE[case]
    path = tmp_path / "grasp.yaml"
    path.write_text(text)
    for load in (ik.load_grasp, ik.load_robot, ik.load_scene):
        with pytest.raises(ik.errors.DescriptionError) as caught:
            load(path)
        assert says in str(caught.value)
        assert len(str(caught.value)) <= ik.errors.MAX_MESSAGE_LENGTH
        assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("contacts: {thumb: {point: [1 kg, 15 deg, 0]}}", "point[0]: found '1 kg', expected m"),
        (
            "contacts: {thumb: {point: [0, 0, 0], normal: [1 mm, 0, 0]}}",
            "normal[0]: found '1 mm', expected a number without a unit",
        ),
        (
            "contacts: {thumb: {point: [0, 0, 0], tolerance: {angle: 3 mm}}}",
            "tolerance.angle: found '3 mm', expected rad",
        ),
        (CONTACT + "object: {name: cup, pose: {xyz: [0, 0, 1 rad]}}", "expected m"),
        (CONTACT + "posture: {spread: 3 kg}", "posture.spread: found '3 kg', expected rad or m"),
    ],
)
def test_units_of_another_dimension(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "grasp.yaml"
    path.write_text(text)
    with pytest.raises(ik.errors.DescriptionError) as caught:
        ik.load_grasp(path)
    assert says in str(caught.value)


@pytest.mark.parametrize("size", [5e-324, 1e-300, 1e-160, 1e-9, 1.0, 1e155, 1e300, 1.7e308])
def test_normals_of_any_length(size: float) -> None:
    direction = np.array([0.6, 0.0, -0.8])
    normal = ik.Contact([0, 0, 0], size * direction).normal
    assert normal is not None
    expected = size * direction / np.abs(size * direction).max()
    np.testing.assert_allclose(normal, expected / np.linalg.norm(expected), rtol=1e-15)


def test_normals_of_any_length_in_a_batch(robot) -> None:
    points, normals = robot.contacts(np.tile(robot.home, (6, 1)))
    scale = np.array([1e-300, 1e-160, 1.0, 1e155, 1e200, 1e300])[:, None, None]
    batch = ik.Solver(robot).solve_batch(points, scale * normals)
    assert batch.success.all()
    with pytest.raises(ik.errors.InputError, match=r"normals:.*0.*0"):
        ik.Solver(robot).solve_batch(points, 0 * normals)


@pytest.mark.parametrize("kind", ["complex", "masked"])
def test_lossy_numbers_are_refused(robot, kind: str) -> None:
    points, normals = robot.contacts(robot.home[None])
    odd = points + 1j if kind == "complex" else np.ma.masked_greater(points, 0)
    solver = ik.Solver(robot)
    with pytest.raises(ik.errors.InputError, match=rf"points:.*numbers: .*{kind}"):
        solver.solve_batch(odd, normals)
    with pytest.raises(ik.errors.InputError, match=f"points: .*{kind}"):
        list(solver.solve_blocks([(odd, normals)]))
    with pytest.raises(ik.errors.InputError, match="point: found"):
        ik.Contact(odd[0, 0])


def test_terminal_commands_in_names_are_escaped() -> None:
    text = str(ik.errors.InputError("\x1b[2J" + "x" * 5000))
    assert text.isprintable()
    assert len(text) <= ik.errors.MAX_MESSAGE_LENGTH
    assert text.endswith("xxx")


def npz(path: Path, shape: tuple[int, ...], data: bytes) -> Path:
    """Write an npz file whose arrays claim a shape."""
    import io
    import zipfile

    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        head, {"descr": "<f8", "fortran_order": False, "shape": shape}
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("points", "normals"):
            archive.writestr(f"{name}.npy", head.getvalue() + data)
    return path


@pytest.mark.parametrize(
    ("shape", "size", "says"),
    [
        ((-1, 3, 3), 720, "found shape"),
        ((10**12, 3, 3), 720, "fewer bytes than its shape"),
        ((1, 3, 3), 2**20, "more bytes than its shape"),
        ((2**22, 3, 3), 2**22 * 72, "expected at most 200 times its size"),
    ],
)
def test_hostile_npz(tmp_path: Path, shape: tuple[int, ...], size: int, says: str) -> None:
    path = npz(tmp_path / "targets.npz", shape, bytes(size))
    with pytest.raises(ik.errors.InputError, match=says):
        ik.load_candidates(path, ROBOT)


@POSIX
def test_endless_file_is_refused() -> None:
    for load in (ik.load_grasp, ik.load_scene, partial(ik.load_candidates, robot=ROBOT)):
        with pytest.raises(ik.errors.DescriptionError, match="/dev/zero"):
            load("/dev/zero")


WORDS = st.sampled_from(
    [
        *("contacts", "robot", "thumb", "point", "normal", "name", "joints", "limits"),
        *("1", "-1e400", ".nan", "~", "<<", "90 deg", "1 kg", "&a", "*a", "!!set", "'"),
        *("[", "]", "{", "}", ":", ",", "\n", "  ", "- "),
    ]
)


def refused(load: Callable[[], object]) -> None:
    """Call a reader, and check that a refusal is one short line."""
    try:
        load()
    except ik.errors.CasadiIKError as error:
        message = str(error)
    else:
        return
    assert len(message) <= ik.errors.MAX_MESSAGE_LENGTH
    assert message.isprintable()


@settings(max_examples=150, deadline=None, derandomize=True, database=None)
@given(st.one_of(st.binary(max_size=200), st.lists(WORDS, max_size=40).map(" ".join)))
def test_any_text_is_read_or_refused(tmp_path_factory, text: bytes | str) -> None:
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    for load in (ik.load_grasp, ik.load_robot, ik.load_scene):
        refused(partial(load, path))


@settings(max_examples=150, deadline=None, derandomize=True, database=None)
@given(place=st.integers(0, 2000), byte=st.integers(0, 255), cut=st.integers(0, 2000))
def test_any_npz_is_read_or_refused(
    tmp_path_factory, robot, place: int, byte: int, cut: int
) -> None:
    path = npz(tmp_path_factory.getbasetemp() / "any.npz", (4, 3, 3), bytes(range(144)) * 2)
    data = bytearray(path.read_bytes())
    data[place % len(data)] = byte
    path.write_bytes(data[: max(1, len(data) - cut % 40)])
    refused(partial(ik.load_candidates, path, robot))
