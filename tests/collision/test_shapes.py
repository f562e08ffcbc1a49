"""Shapes of robots: descriptions, fitted shapes of imported files, URDF output, and refusals."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pinocchio
import pytest
import trimesh
import yaml
from capsule_arm import ARM, write_robot
from collision_queries import query_at
from scipy.spatial import KDTree

import casadi_ik as ik
from casadi_ik import model as robots
from casadi_ik.collision.clearance import SceneCheck
from casadi_ik.collision.model import collision_model
from casadi_ik.files.reading import Frame, frame_matrix, validated
from casadi_ik.integrations.importing import capsules, robot_import
from casadi_ik.integrations.importing.meshes import IndexedMesh
from casadi_ik.integrations.importing.write import collision_lines
from casadi_ik.model.link_shapes import Touching, capsules_of
from casadi_ik.model.schema import CollisionEntry, LinkBoxEntry, LinkCapsuleEntry, LinkCylinderEntry

PLACE = '<origin xyz="0 0 0.02" rpy="0.3 0.2 0.1"/>'
SIMPLE = {
    "palm": '<box size="0.1 0.06 0.02"/>',
    "left_1": '<cylinder radius="0.01" length="0.05"/>',
    "right_1": '<sphere radius="0.012"/>',
    "left_2": '<cylinder radius="0.008" length="0.04"/>',
}


def write_hand(folder: Path, right_2: str = '<sphere radius="0.01"/>') -> Path:
    """Write a hand of two opposed fingers of two links each, with a shape on every link."""
    shapes = SIMPLE | {"right_2": right_2}
    text = "".join(
        f'<link name="{name}"><collision>{PLACE}<geometry>{shape}</geometry></collision></link>\n'
        for name, shape in shapes.items()
    )
    for side, y, axis in (("left", 0.04, "1 0 0"), ("right", -0.04, "-1 0 0")):
        for number, parent, xyz in ((1, "palm", f"0 {y} 0.05"), (2, f"{side}_1", "0 0 0.05")):
            text += (
                f'<joint name="{side}_j{number}" type="revolute"><origin xyz="{xyz}"/>'
                f'<parent link="{parent}"/><child link="{side}_{number}"/><axis xyz="{axis}"/>'
                '<limit lower="-0.2" upper="1.2" velocity="1" effort="1"/></joint>\n'
            )
    path = folder / "hand.urdf"
    path.write_text(f'<robot name="hand">{text}</robot>')
    return path


def write_mesh(folder: Path, rng: np.random.Generator) -> np.ndarray:
    """Write a bent slab as an STL file and return its corners."""
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.01, 0.01, 5), np.linspace(0, 1, 9)))
    top = np.column_stack([x, 0.02 * y * y, 0.05 * y]) + rng.normal(0, 1e-4, (45, 3))
    points = np.concatenate([top, top + np.array([0, 0.006, 0])])
    lines = ["solid slab"]
    for layer in (0, 45):
        for row in range(8):
            for column in range(4):
                i = layer + 5 * row + column
                for corners in ((i, i + 1, i + 5), (i + 1, i + 6, i + 5)):
                    three = points[list(corners)]
                    inner = "".join(f"vertex {a:.9g} {b:.9g} {c:.9g}\n" for a, b, c in three)
                    lines.append(f"facet normal 0 0 1\nouter loop\n{inner}endloop\nendfacet")
    (folder / "slab.stl").write_text("\n".join([*lines, "endsolid slab\n"]))
    return points


DESCRIPTION = """
name: mine
hand: {file: hand.urdf, palm: palm}
fingers:
  left: {link: left_2, xyz: [0, -0.01, 0.03], normal: [0, -1, 0]}
  right: {link: right_2, xyz: [0, 0.01, 0.03], normal: [0, 1, 0]}
"""


def test_shapes_come_with_the_parts(tmp_path):
    shapes = robots.load_description(write_robot(tmp_path)).shapes
    assert [capsule.link for capsule in shapes.capsules if capsule.covers < 0] == [
        *("l1", "l3", "l3"),
        *("tip1", "tip2"),
    ]
    assert [(capsule.link, capsule.kind) for capsule in shapes.solids] == [
        ("base", "cylinder"),
        ("l2", "box"),
        ("palm", "box"),
    ]
    covers = {
        capsule.link: shapes.solids[capsule.covers].link
        for capsule in shapes.capsules
        if capsule.covers > -1
    }
    assert covers == {"base": "base", "l2": "l2", "palm": "palm"}


@pytest.mark.parametrize(
    "shape",
    [
        LinkBoxEntry(size=(0.3, 0.1, 0.08), xyz=(0.1, 0.2, 0.3), rpy=(0.3, 0.2, 0.1)),
        LinkBoxEntry(size=(0.2, 0.2, 0.01)),
        LinkCylinderEntry(radius=0.05, length=0.3, rpy=(1.0, 0, 0)),
        LinkCylinderEntry(radius=0.1, length=0.02),
    ],
)
def test_capsules_hold_boxes_and_cylinders(shape, rng):
    unit = rng.uniform(-1, 1, (4000, 3))
    if isinstance(shape, LinkBoxEntry):
        corners = unit * np.array(shape.size) / 2
    else:
        corners = unit[np.hypot(unit[:, 0], unit[:, 1]) <= 1]
        corners = corners * [shape.radius, shape.radius, shape.length / 2]
    pose = frame_matrix(Frame(shape.xyz, shape.rpy))
    points = corners @ pose[:3, :3].T + pose[:3, 3]
    separations = []
    for center, half_axis, radius in capsules_of(shape):
        t = np.clip((points - center) @ half_axis / max(half_axis @ half_axis, 1e-30), -1, 1)
        separations.append(
            np.linalg.norm(points - center - t[:, None] * half_axis, axis=1) - radius
        )
    assert np.min(separations, axis=0).max() <= 1e-9


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("links", "l9"), [], "collision.links.l9: unknown link 'l9'; known: base, l1"),
        (
            ("links", "l1", 0, "radius"),
            -1,
            r"collision.links.l1\[0\].radius: found -1, expected >",
        ),
        (("links", "l1", 0, "kind"), "cone", "'cone'"),
        (("links", "l1", 0, "radius"), "5 deg", "found '5 deg', expected m"),
        (("touching",), [{"links": ["l1", "x"], "reason": "a"}], "unknown link 'x'"),
        (("touching",), [{"links": ["l1", "l3"], "reason": " "}], "reason: is empty"),
        (("source",), "nobody", "tag 'nobody' is unknown"),
        (("srdf",), "none.srdf", "none.srdf: cannot be read"),
    ],
)
def test_bad_shapes_are_named(tmp_path, place, value, message):
    path = write_robot(tmp_path)
    arm = copy.deepcopy(ARM)
    at = arm["collision"]
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = value
    (tmp_path / "three.yaml").write_text(yaml.safe_dump(arm))
    with pytest.raises(ik.errors.DescriptionError, match=message) as caught:
        robots.load_description(path)
    assert "\n" not in str(caught.value)
    assert "three.yaml" in str(caught.value) or "none.srdf" in str(caught.value)


def test_srdf_exceptions_are_read(tmp_path):
    path = write_robot(tmp_path)
    arm = copy.deepcopy(ARM)
    arm["collision"]["srdf"] = "three.srdf"
    (tmp_path / "three.yaml").write_text(yaml.safe_dump(arm))
    (tmp_path / "three.srdf").write_text(
        "<robot name='three'><disable_collisions link1='base' link2='l3' reason='Never'/>"
        "<disable_collisions link1='base' link2='elsewhere' reason='Never'/></robot>"
    )
    excluded = collision_model(robots.load_description(path)).excluded
    assert ("base", "l3", "three.srdf: Never") in [(*pair.links, pair.reason) for pair in excluded]


def test_robot_without_shapes_takes_no_scene(tmp_path):
    path = write_robot(tmp_path)
    arm = {key: value for key, value in ARM.items() if key != "collision"}
    (tmp_path / "three.yaml").write_text(yaml.safe_dump(arm))
    robot = ik.load_robot(path)
    with pytest.raises(ik.errors.UnsupportedError, match=": arm has no shapes"):
        ik.Solver(robot, scene=ik.Scene())


@pytest.mark.parametrize(
    "name",
    [
        "kuka_lwr_barrett",
        "kuka_lwr_barrett_coupled",
        "panda+allegro_right",
        "ur5e+shadow",
        "iiwa14+leap",
        "sawyer+robotiq_3f",
        "xarm6+unitree_dex3",
        "ar10",
    ],
)
def test_shipped_robots_are_collision_free_at_home(name):
    """At home no checked links touch: the shapes are not too large."""
    robot = ik.load_robot(name)
    check = SceneCheck(robot, ik.Scene(), compiled=False)
    solver = ik.Solver(robot, scene=ik.Scene(), compiled=False)
    verdict = query_at(solver, robot.home).check(robot.home[None])
    assert verdict.free[0], verdict.pair(0)
    assert all(pair.reason for pair in check.model.excluded)


@pytest.mark.parametrize(
    ("arm", "link", "corner"),
    [
        # Corners [mm] of visual meshes: dexsuite/dex-urdf at 93505db3c0b2 (iiwa),
        # example-robot-data 6.0.0 (Jaco, UR10), robosuite 1.5.2 (Sawyer, bullet_data).
        ("iiwa14", "iiwa14_link_2", [-55.0, -237.3, 40.0]),
        ("iiwa7", "iiwa7_link_2", [34.0, -216.8, -58.9]),
        ("jaco2", "jaco2_link_2", [42.7, -3.5, 11.5]),
        ("ur10", "ur10_link_2", [-664.1, 101.6, 253.6]),
        ("sawyer", "sawyer_link_1", [-67.9, 2.9, 1.0]),
    ],
)
def test_shapes_enclose_the_visible_arm(arm, link, corner):
    """The outermost corners of collision meshes stand out of the fitted shapes by little."""
    shapes = ik.load_robot(f"{arm}+barrett_bh8_280").description.shapes
    point = np.array(corner) / 1e3
    separations = []
    for capsule in shapes.capsules:
        if capsule.link == link:
            square = capsule.half_axis @ capsule.half_axis
            fraction = (
                np.clip((point - capsule.center) @ capsule.half_axis / square, -1, 1)
                if square
                else 0.0
            )
            separations.append(
                np.linalg.norm(point - capsule.center - fraction * capsule.half_axis)
                - capsule.radius
            )
    assert min(separations) < 1e-4


def test_simple_shapes_are_read_from_the_description(tmp_path: Path) -> None:
    write_hand(tmp_path)
    path = tmp_path / "mine.yaml"
    path.write_text(DESCRIPTION)
    shapes = robots.load_description(path).shapes
    assert [(solid.link, solid.kind, solid.size.tolist()) for solid in shapes.solids] == [
        ("palm", "box", [0.1, 0.06, 0.02]),
        ("left_1", "cylinder", [0.01, 0.05, 0.0]),
        ("left_2", "cylinder", [0.008, 0.04, 0.0]),
    ]
    spheres = [solid for solid in shapes.capsules if solid.covers < 0]
    assert [(solid.link, solid.radius) for solid in spheres] == [
        ("right_1", 0.012),
        ("right_2", 0.01),
    ]
    np.testing.assert_allclose(spheres[0].center, [0, 0, 0.02])
    # Shapes of a link in the description replace those of its file.
    collision_text = "collision: {links: {palm: [{kind: sphere, radius: 5 cm}]}}\n"
    path.write_text(DESCRIPTION + collision_text)
    palm = [
        solid for solid in robots.load_description(path).shapes.capsules if solid.link == "palm"
    ]
    assert [solid.radius for solid in palm] == [0.05]


def test_unfitted_meshes_are_not_shapes(tmp_path: Path, rng) -> None:
    write_mesh(tmp_path, rng)
    write_hand(tmp_path, '<mesh filename="slab.stl"/>')
    path = tmp_path / "mine.yaml"
    path.write_text(DESCRIPTION)
    with pytest.raises(ik.errors.UnsupportedError, match=": hand has no shapes"):
        collision_model(robots.load_description(path))


def test_imported_shapes_enclose_the_meshes(tmp_path: Path, rng) -> None:
    points = write_mesh(tmp_path, rng)
    hand = write_hand(tmp_path, '<mesh filename="slab.stl"/>')
    (tmp_path / "hand.srdf").write_text(
        "<robot name='x'>"
        "<disable_collisions link1='left_2' link2='right_2' reason='Never'/></robot>"
    )
    out = tmp_path / "mine.yaml"
    report = robot_import.import_robot(None, hand, out, command="casadi-ik import")
    out.write_text(report.description.to_yaml())
    report = report.with_home(out).with_shapes(out, tmp_path / "hand.srdf")
    out.write_text(report.description.to_yaml())
    entry = yaml.safe_load(out.read_text())["collision"]
    assert entry["links"]["left_1"][0]["kind"] == "cylinder"
    assert entry["links"]["left_1"][0]["radius"] == "10 mm"
    fitted = entry["links"]["right_2"]
    assert {shape_entry["kind"] for shape_entry in fitted} <= {"capsule", "sphere"}
    excess = float(fitted[0]["excess"].removesuffix(" mm"))
    assert 0 < excess < 20
    description = robots.load_description(out)
    # The mesh has the pose of the file in the link's frame.
    pose = frame_matrix(Frame((0, 0, 0.02), (0.3, 0.2, 0.1)))
    mesh = points @ pose[:3, :3].T + pose[:3, 3]
    separation = np.full(len(mesh), np.inf)
    for shape_entry in description.shapes.capsules:
        if shape_entry.link == "right_2":
            t = np.clip(
                (mesh - shape_entry.center)
                @ shape_entry.half_axis
                / max(shape_entry.half_axis @ shape_entry.half_axis, 1e-30),
                -1,
                1,
            )
            gap = (
                np.linalg.norm(
                    mesh - shape_entry.center - t[:, None] * shape_entry.half_axis, axis=1
                )
                - shape_entry.radius
            )
            separation = np.minimum(separation, gap)
    assert separation.max() <= 0
    assert sum(shape_entry.link == "right_2" for shape_entry in description.shapes.capsules) == len(
        fitted
    )
    excluded = {
        frozenset(shape_entry.links): shape_entry.reason
        for shape_entry in collision_model(description).excluded
    }
    assert excluded[frozenset(("left_2", "right_2"))] == "hand.srdf: Never"
    assert SceneCheck(ik.ArmHand(description), ik.Scene(), compiled=False).model.pairs.size


def test_written_shapes_round_trip(tmp_path: Path) -> None:
    """Shapes survive writing and reading the YAML file."""
    shapes = {
        "a link": [
            LinkBoxEntry(size=(0.1, 0.2, 0.3), xyz=(0.01, 0, 0), rpy=(0.1, 0, 0), excess=0.004)
        ],
        "b": [LinkCapsuleEntry(ends=((0, 0, 0), (0, 0, 0.1)), radius=0.02)],
    }
    lines = collision_lines(shapes, [Touching(("a link", "b"), "they do", 0.003)], "shapes")
    entry, _ = validated(yaml.safe_load("\n".join(lines))["collision"], CollisionEntry, tmp_path)
    assert entry.links["a link"] == shapes["a link"]
    assert entry.links["b"] == shapes["b"]
    assert entry.touching[0].depth == 0.003
    assert len(capsules_of(entry.links["b"][0])) == 1


def test_capsule_overhang_is_bounded_from_few_points():
    """The result is that of every sample against every point, with all corners covered."""
    rng = np.random.default_rng(0)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    low, high = np.array([-0.05, -0.02, -0.1]), np.array([0.05, 0.03, 0.1])
    corners = (
        np.array([[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)]) @ rotation
    )
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6)]
    triangles = corners[np.array([*faces, (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)])]
    fitted, overhang = capsules.fit_capsules(triangles, 3)
    points, numbers = capsules.subdivide(triangles)
    distances = np.min([capsule.distances_to(points) for capsule in fitted], axis=0)
    assert distances.max() <= 1e-12
    skin = np.concatenate([capsule.surface_points() for capsule in fitted])
    skin = skin[np.min([capsule.distances_to(skin) for capsule in fitted], axis=0) >= -1e-6]
    samples = np.concatenate([points, points[numbers].mean(axis=1)])
    nearest = np.linalg.norm(skin[:, None] - samples, axis=2).min(axis=1)
    assert overhang == pytest.approx(nearest.max(), abs=1e-9)
    assert len(fitted) > 1


def test_fine_mesh_is_simplified_within_a_cell_and_enclosed():
    ball = trimesh.creation.icosphere(5, 0.02)
    mesh = IndexedMesh(np.asarray(ball.vertices) * [1, 1, 2], np.asarray(ball.faces))
    coarse = mesh.simplified(3000, 40)
    assert mesh.simplified(len(mesh.triangles), 40) is mesh
    assert 500 < len(coarse.triangles) < len(mesh.triangles) / 2
    distances, _ = KDTree(coarse.points).query(mesh.points)
    assert distances.max() <= np.sqrt(3) * 0.08 / 40
    fitted, overhang = capsules.fit_capsules(mesh.points[mesh.triangles], 1)
    assert fitted[0].distances_to(mesh.points).max() <= 0
    assert fitted[0].radius < 0.0215
    assert overhang < 0.006


def test_shapes_come_back_from_the_urdf(tmp_path):
    robot = ik.load_robot(write_robot(tmp_path))
    text = robot.urdf()
    model = pinocchio.buildModelFromXML(text)
    geometry = pinocchio.buildGeomFromUrdfString(model, text, pinocchio.GeometryType.COLLISION)
    kinds = sorted(type(item.geometry).__name__ for item in geometry.geometryObjects)
    # Four capsules (a cylinder and two spheres each), a sphere, two boxes and a cylinder.
    assert kinds == ["Box"] * 2 + ["Cylinder"] * 5 + ["Sphere"] * 9
    box = next(
        item for item in geometry.geometryObjects if model.frames[item.parentFrame].name == "l2"
    )
    place = (model.frames[box.parentFrame].placement.inverse() * box.placement).homogeneous
    solid = next(item for item in robot.description.shapes.solids if item.link == "l2")
    np.testing.assert_allclose(place, solid.pose, atol=1e-12)
    np.testing.assert_allclose(2 * np.asarray(box.geometry.halfSide), solid.size, atol=1e-12)


def test_equal_meshes_of_two_links_get_equal_shapes(rng):
    """The order of triangles and rounding do not matter; a mirrored mesh is not equal."""
    t = np.array([0.02, 0.0, 0.02])
    mesh = trimesh.util.concatenate(
        [
            trimesh.creation.box((0.02, 0.02, 0.06)),
            trimesh.creation.box((0.02, 0.02, 0.02), trimesh.transformations.translation_matrix(t)),
            trimesh.creation.box(
                (0.02, 0.02, 0.02), trimesh.transformations.translation_matrix(-t)
            ),
        ]
    )
    points, triangles = np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64)
    first = IndexedMesh(points, triangles)
    noise = rng.uniform(-1e-9, 1e-9, points.shape)
    permuted = IndexedMesh(points + noise, triangles[rng.permutation(len(triangles))])
    mirrored = IndexedMesh(points * [-1, 1, 1], triangles)
    assert capsules.is_same(first, permuted)
    assert not capsules.is_same(first, mirrored)
    shapes = capsules.fit_links({"a": first, "b": permuted, "c": mirrored}, ())
    assert shapes["a"] == shapes["b"]
    assert shapes["a"] != shapes["c"]
