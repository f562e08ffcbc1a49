"""Visual meshes of built-in robots, read from packages that contain the same robots."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from msgspec import structs

import casadi_ik as ik
from casadi_ik.app.drawing import palette
from casadi_ik.app.drawing.drawables import bodies_at, collision_bodies, visual_bodies
from casadi_ik.app.drawing.mesh_table import (
    MeshTable,
    PackageEntry,
    PlacedMeshEntry,
    VisualMeshEntry,
    fetch_repository,
    mesh_table,
)
from casadi_ik.app.drawing.surfaces import decimate
from casadi_ik.app.drawing.visual_meshes import package_meshes
from casadi_ik.files.arrays import Array
from casadi_ik.files.number_files import read_mesh_parts
from casadi_ik.files.reading import Frame, frame_matrix, roll_pitch_yaw
from casadi_ik.files.shipped import shipped_names
from casadi_ik.integrations.importing.meshes import IndexedMesh
from casadi_ik.model.pose import inverse

PACKAGE = "made-up-robots"
JOINTS = {f"panda_joint_{i}": f"axis{i}" for i in range(1, 8)}
TABLE = MeshTable(
    {PACKAGE: PackageEntry("made_up_robots/data")},
    {
        "panda": [
            VisualMeshEntry(PACKAGE, "MIT", "arm/*.urdf", {"panda_base": "base"}, JOINTS, ["cover"])
        ]
    },
)
SHIFT = np.eye(4)
"""Pose of a link of the file in the link of the robot: both frames lie on the joint's axis, z."""
SHIFT[:3] = [[0.8, -0.6, 0, 0], [0.6, 0.8, 0, 0], [0, 0, 1, 0.05]]

BOX = '<visual><origin xyz="{}"/><geometry><box size="0.02 0.02 0.02"/></geometry>{}</visual>'


def about_z(degrees: float) -> Array:
    """Return the (4, 4) rotation about z."""
    return frame_matrix(Frame(rpy=(0.0, 0.0, np.deg2rad(degrees))))


def write_package(site: Path, error: float = 0.0, is_turned: bool = False) -> None:
    """Write an installed package with a Panda whose frames differ from those of the robot.

    Args:
        site: Folder of installed packages.
        error: Displacement of an axis [m].
        is_turned: Whether the base is turned by 90 deg, and the zero of the second axis by 30 deg.
    """
    info = site / "made_up_robots-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {PACKAGE}\nVersion: 1.0\n")
    folder = site / "made_up_robots" / "data" / "arm"
    folder.mkdir(parents=True)
    joints = [joint for joint in ik.load_robot("panda").description.movable if joint.part == "arm"]
    red = '<material name="red"><color rgba="1 0 0 1"/></material>'
    parts = [red, f'<link name="base">{BOX.format("0 0 0", "")}</link>']
    parts.append(f'<link name="cover">{BOX.format("0 0 0.5", "")}</link>')
    parts.append(
        '<joint name="glue" type="fixed"><parent link="link3"/><child link="cover"/></joint>'
    )
    for i, joint in enumerate(joints, 1):
        placement = (inverse(SHIFT) if i > 1 else np.eye(4)) @ joint.placement @ SHIFT
        placement[:3, 3] += error * (i == 4) * placement[:3, 0]
        if is_turned and i <= 2:
            turn = about_z(-90.0) if i == 1 else about_z(-30.0)
            placement = turn @ placement if i == 1 else placement @ turn
        xyz, rpy = placement[:3, 3], roll_pitch_yaw(placement[:3, :3])
        origin = f'xyz="{xyz[0]} {xyz[1]} {xyz[2]}" rpy="{rpy[0]} {rpy[1]} {rpy[2]}"'
        box = BOX.format("0 0 0", '<material name="red"/>')
        parent = f"link{i - 1}" if i > 1 else "base"
        parts.append(f'<link name="link{i}">{box}</link>')
        parts.append(
            f'<joint name="axis{i}" type="continuous"><parent link="{parent}"/>'
            f'<child link="link{i}"/><origin {origin}/><axis xyz="0 0 1"/></joint>'
        )
    (folder / "arm.urdf").write_text(f'<robot name="arm">{"".join(parts)}</robot>')


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty folder of installed packages."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("CASADI_IK_CACHE", str(tmp_path / "cache"))
    return folder


def test_meshes_of_an_installed_package_are_placed_and_colored(site: Path) -> None:
    write_package(site)
    description = ik.load_robot("panda").description
    for _ in range(2):  # the second time from the cache
        meshes = package_meshes(description, TABLE)
        assert meshes.origins == ((PACKAGE, "MIT"),)
        assert set(meshes.by_link) == {"panda_base", *(f"panda_link_{i}" for i in range(1, 8))}
        assert set(meshes.by_link) == meshes.covered_links
        centers = {
            (link, part.color): part.mesh.points.mean(axis=0)
            for link, parts in meshes.by_link.items()
            for part in parts
        }
        expected = {(f"panda_link_{i}", "#ff0000"): SHIFT[:3, 3] for i in range(1, 8)}
        # The cover is fixed to the third link, half a metre along its axis.
        expected |= {("panda_base", ""): np.zeros(3), ("panda_link_3", ""): [0, 0, 0.55]}
        assert set(centers) == set(expected)
        for key, center in expected.items():
            assert centers[key] == pytest.approx(center, abs=1e-6)


def test_frames_and_zeros_may_differ(site: Path) -> None:
    write_package(site, is_turned=True)
    description = ik.load_robot("panda").description
    entry = TABLE.robots["panda"][0]
    assert not package_meshes(description, TABLE).by_link
    turned_entry = structs.replace(
        entry, rpy=(0.0, 0.0, np.pi / 2), zeros={"panda_joint_2": np.deg2rad(30.0)}
    )
    meshes = package_meshes(description, MeshTable(TABLE.packages, {"panda": [turned_entry]}))
    for i in range(1, 8):
        (part,) = [part for part in meshes.by_link[f"panda_link_{i}"] if part.color]
        assert part.mesh.points.mean(axis=0) == pytest.approx(SHIFT[:3, 3], abs=1e-6)


def git(folder: Path, *arguments: str) -> str:
    """Run Git in a folder and return its output."""
    settings = ("-c", "user.name=x", "-c", "user.email=x@example.org")
    command = ["git", "-C", str(folder), *settings, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


@pytest.mark.skipif(shutil.which("git") is None, reason="needs git")
def test_repositories_are_fetched_and_place_meshes(site: Path, tmp_path: Path) -> None:
    repository = tmp_path / "repository"
    for folder in ("meshes", "other"):
        (repository / folder).mkdir(parents=True)
        trimesh.creation.box((0.1, 0.1, 0.1)).export(repository / folder / "box.stl")
    git(repository, "init", "--quiet")
    git(repository, "add", ".")
    git(repository, "commit", "--quiet", "-m", "boxes")
    commit = git(repository, "rev-parse", "HEAD")
    files = [PlacedMeshEntry("meshes/box.stl", (0.0, 0.0, 0.3), (0.0, 0.0, 0.0), "#000000")]
    table = MeshTable(
        {"boxes": PackageEntry(repository=repository.as_uri(), commit=commit)},
        {"panda": [VisualMeshEntry("boxes", "MIT", meshes={"panda_link_3": files})]},
    )
    description = ik.load_robot("panda").description
    assert not package_meshes(description, table).by_link
    folder = fetch_repository("boxes", table)
    assert {path.name for path in folder.iterdir()} == {".git", "meshes"}
    meshes = package_meshes(description, table)
    assert meshes.covered_links == {"panda_link_3"}
    (part,) = meshes.by_link["panda_link_3"]
    assert part.mesh.points.mean(axis=0) == pytest.approx([0, 0, 0.3])
    assert min(palette.rgb(part.color)) > 0  # black is lightened, so that shading is visible


def test_packages_on_the_index_are_not_fetched(site: Path) -> None:
    assert not list(site.iterdir())
    with pytest.raises(ik.errors.InputError, match=PACKAGE):
        fetch_repository(PACKAGE, TABLE)


@pytest.mark.parametrize("write", [None, lambda site: write_package(site, error=5e-3)])
def test_missing_and_different_robots_are_not_used(
    site: Path, write: Callable[[Path], None] | None
) -> None:
    if write is not None:
        write(site)
    meshes = package_meshes(ik.load_robot("panda").description, TABLE)
    assert not meshes.by_link
    assert not meshes.covered_links


def test_each_arm_of_a_multi_arm_robot_has_meshes(site: Path) -> None:
    write_package(site)
    robot = ik.load_robot("two_pandas+allegro")
    links = set(package_meshes(robot.description, TABLE).by_link)
    assert {"left_panda_base", "left_panda_link_7", "right_panda_link_7"} <= links


@pytest.mark.parametrize("name", ["kuka_lwr_barrett", "mobile_kuka_lwr_barrett"])
def test_hulls_have_the_size_of_the_robot(site: Path, name: str) -> None:
    assert not list(site.iterdir())
    robot, table = ik.load_robot(name), mesh_table()
    meshes = package_meshes(robot.description, structs.replace(table, packages={}, robots={}))
    shapes = bodies_at(robot, robot.home, collision_bodies(robot))
    poses = robot.links(robot.home)
    for name in ("lwr_base", "lwr_link_3", "lwr_flange", "bh_base", "bh_thumb_link_3"):
        assert any(link.endswith(name) for link in meshes.covered_links)
    for link in meshes.covered_links:
        hull = np.concatenate([part.mesh.points for part in meshes.by_link[link]])
        solid = [body.surface.points for body in shapes if body.name == link]
        placed_hull = hull @ poses[link][:3, :3].T + poses[link][:3, 3]
        for bound in (np.min, np.max):
            # Collision shapes enclose a link with an excess of up to 78 mm.
            assert bound(placed_hull, axis=0) == pytest.approx(
                bound(np.concatenate(solid), axis=0), abs=0.06
            )


def test_links_without_meshes_are_drawn_by_collision_shapes(site: Path) -> None:
    assert not list(site.iterdir())
    robot = ik.load_robot("irb140+panda_hand")
    frames = [body.frame for body in visual_bodies(robot) if body.role != "pad"]
    assert {body.frame for body in collision_bodies(robot)} <= set(frames)


def test_entries_name_joints_and_links_of_built_in_robots() -> None:
    table = mesh_table()
    names = [name for kind in ("arms", "hands", "bodies") for name in shipped_names(kind)]
    robots = [ik.load_robot(name).description for name in names if name in table.robots]
    robots.append(ik.load_robot("g1+dex3").description)
    for entries in table.robots.values():
        for entry in entries:
            assert entry.licence
            assert entry.package in table.packages
            assert any(
                set(entry.joints) <= {joint.name for joint in robot.joints}
                and set(entry.links) <= set(robot.links)
                for robot in robots
            )


def test_decimated_meshes_keep_their_volume() -> None:
    ball = trimesh.creation.icosphere(subdivisions=5)
    # The triangles share no points, as in STL files.
    surface = IndexedMesh(
        ball.vertices[ball.faces].reshape(-1, 3), np.arange(3 * len(ball.faces)).reshape(-1, 3)
    )
    reduced = decimate(surface, 2000)
    assert len(reduced.triangles) <= 2000
    mesh = trimesh.Trimesh(reduced.points, reduced.triangles, process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(ball.volume, rel=0.01)


COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="1"/><up_axis>Z_UP</up_axis></asset>
<library_effects><effect id="paint"><profile_COMMON><technique sid="common"><lambert>
<diffuse><color>1 0.502 0 1</color></diffuse></lambert></technique></profile_COMMON></effect>
</library_effects>
<library_materials><material id="orange"><instance_effect url="#paint"/></material>
</library_materials>
<library_geometries><geometry id="part"><mesh>
<source id="corners"><float_array id="numbers" count="9">0 0 0 1 0 0 0 1 0</float_array>
<technique_common><accessor source="#numbers" count="3" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
</accessor></technique_common></source>
<vertices id="vertices"><input semantic="POSITION" source="#corners"/></vertices>
<triangles count="1" material="paint-1"><input semantic="VERTEX" source="#vertices" offset="0"/>
<p>0 1 2</p></triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="scene"><node><instance_geometry url="#part">
<bind_material><technique_common><instance_material symbol="paint-1" target="#orange"/>
</technique_common></bind_material></instance_geometry></node></visual_scene>
</library_visual_scenes>
<scene><instance_visual_scene url="#scene"/></scene></COLLADA>"""


@pytest.mark.parametrize(("old", "new", "color"), [("", "", "#ff8000"), ("0.502", "x", "")])
def test_collada_files_state_colors(tmp_path: Path, old: str, new: str, color: str) -> None:
    file = tmp_path / "part.dae"
    file.write_text(COLLADA.replace(old, new) if old else COLLADA)
    (part,) = read_mesh_parts(file, "part.dae")
    assert part.color == color
    assert part.points.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
