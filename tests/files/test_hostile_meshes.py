"""Broken or oversized meshes give one line each, and do not crash the process."""

from __future__ import annotations

import random
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from commands import main
from processes import python

import casadi_ik as ik

DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="cm" meter="0.01"/><up_axis>Y_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh><source id="p">
<float_array id="pa" count="15">{corners} 100 100 100</float_array><technique_common>
<accessor source="#pa" count="5" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4" material="none"><input semantic="VERTEX" source="#v" offset="0"/>
<p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node id="n"><translate>1 0 0</translate>
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""
"""COLLADA file in centimetres with a translation, an unused corner and a missing material."""

CORNERS = np.array([[0, 0, 0], [10, 0, 0], [0, 20, 0], [0, 0, 30]])

SCENE = """import sys, casadi_ik as ik
for path in sys.argv[1:]:
    try:
        ik.load_scene(path)
    except ik.CasadiIKError as error:
        assert len(str(error).splitlines()) == 1, error
print("lived")
"""


def tetrahedron(folder: Path, kind: str) -> Path:
    """Write a tetrahedron [cm, or m] in one of the formats."""
    path = folder / f"body.{kind.removeprefix('ascii_')}"
    if kind == "dae":
        path.write_text(DAE.format(corners=" ".join(map(str, CORNERS.ravel()))))
        return path
    faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    mesh = trimesh.Trimesh(CORNERS, faces, process=False)
    if kind == "ascii_stl":
        mesh.export(path, file_type="stl_ascii")
    else:
        options = {"encoding": "ascii"} if kind == "ascii_ply" else {}
        mesh.export(path, file_type=path.suffix[1:], **options)
    return path


KINDS = ("stl", "ascii_stl", "obj", "ply", "ascii_ply", "dae", "off", "glb")


def scene(mesh: Path, scale: float = 0.01) -> Path:
    """Write a scene with that mesh."""
    path = mesh.with_name(f"{mesh.name}.yaml")
    text = f"{{kind: mesh, file: {mesh.name}, scale: {scale}}}"
    path.write_text(f"name: one\nsolids: {{body: {text}}}\n")
    return path


@pytest.mark.parametrize("kind", KINDS)
def test_a_mesh_is_read_in_metres(tmp_path: Path, kind: str) -> None:
    path = tetrahedron(tmp_path, kind)
    scene_items = ik.load_scene(scene(path, 1.0 if kind == "dae" else 0.01))
    ((solid, pose),) = scene_items.items["body"].parts
    corners = CORNERS / 100 + [0.01 if kind == "dae" else 0, 0, 0] - pose[:3, 3]
    outside = corners @ solid.planes[:, :3].T - solid.planes[:, 3]
    np.testing.assert_allclose(np.sort(outside)[:, -3:], 0, atol=1e-7)  # each on three planes


SHARDS = (b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\xc0\x7f", b"nan", b"-1", b"9" * 11)


def damaged(data: bytes, rng: random.Random) -> bytes:
    """Return a file's bytes, some of them deleted, repeated, or replaced by large numbers."""
    changed_data = bytearray(data)
    for _ in range(rng.choice((1, 2, 8))):
        i = rng.randrange(len(changed_data) + 1)
        match rng.randrange(4):
            case 0:
                del changed_data[i : i + rng.choice((1, 4, 40))]
            case 1:
                changed_data[i:i] = changed_data[: rng.choice((1, 4, 40))]
            case 2:
                changed_data[i : i + 4] = rng.choice(SHARDS)
            case _:
                changed_data = changed_data[:i] if i > len(changed_data) / 2 else changed_data
    return bytes(changed_data)


def test_broken_meshes_do_not_crash_the_process(tmp_path: Path) -> None:
    rng, paths = random.Random(0), []
    for kind in KINDS:
        data = tetrahedron(tmp_path, kind).read_bytes()
        for i in range(25):
            path = tmp_path / f"{kind}_{i}.{kind.removeprefix('ascii_')}"
            path.write_bytes(damaged(data, rng))
            paths.append(str(scene(path)))
    done = python("-c", SCENE, *paths)
    assert (done.returncode, done.stdout, done.stderr) == (0, "lived\n", "")


def test_oversized_meshes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "ball.ply"
    trimesh.creation.icosphere(subdivisions=1).export(path)  # 80 triangles in less than 2 kB
    for factor, says in (
        ("1e-5", "is larger than"),
        ("3e-5", "found 80 triangles, expected at mo"),
    ):
        monkeypatch.setenv("CASADI_IK_LIMITS", factor)
        with pytest.raises(ik.errors.DescriptionError, match=says) as caught:
            ik.load_scene(scene(path))
        assert "ball.ply" in str(caught.value)
        assert "CASADI_IK_LIMITS" in str(caught.value)


def stl(count: int, triangles: int) -> bytes:
    """Return a binary STL file of a tetrahedron, with the number of triangles that it states."""
    faces = [CORNERS[list(face)] for face in ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))]
    rows = [struct.pack("<12fH", 0, 0, 0, *np.ravel(face), 0) for face in faces[:triangles]]
    return b"exported".ljust(80) + struct.pack("<I", count) + b"".join(rows)


def test_bytes_after_the_triangles_of_an_stl_file_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / "part.stl"
    path.write_bytes(stl(4, 4) + b"material: steel")
    ((solid, pose),) = ik.load_scene(scene(path)).items["body"].parts
    outside = (CORNERS / 100 - pose[:3, 3]) @ solid.planes[:, :3].T - solid.planes[:, 3]
    np.testing.assert_allclose(np.sort(outside)[:, -3:], 0, atol=1e-7)  # each on three planes


@pytest.mark.parametrize(
    ("name", "data", "problem"),
    [
        ("part.stl", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "LFS"),
        ("part.obj", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "LFS"),
        ("part.stl", b"\n<!DOCTYPE html><html>404: Not Found</html>".ljust(200), "web page"),
        ("part.stl", stl(1000, 4), "284 of 50084 bytes"),
        ("part.ply", b"", "0 bytes"),
    ],
)
def test_a_file_that_is_not_there_in_full(
    tmp_path: Path, name: str, data: bytes, problem: str
) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(ik.errors.DescriptionError, match=f"{name}.*{problem}"):
        ik.load_scene(scene(path))


def test_a_description_that_is_a_pointer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
    assert main(["import", str(path), "--out", str(tmp_path / "robot.yaml")]) == 2
    assert "robot.urdf: the file is a Git LFS pointer" in capsys.readouterr().err
    assert not (tmp_path / "robot.yaml").exists()
