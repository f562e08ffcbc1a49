"""Objects in URDF files, as in the object sets of simulators."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

import casadi_ik as ik

CAN = """<?xml version="1.0"?>
<robot name="can">
  <link name="base_link">
    <inertial><mass value="0.3"/></inertial>
    <visual>
      <origin xyz="0 0 0.1" rpy="0 0 0"/>
      <geometry><mesh filename="{mesh}" scale="0.5 0.5 0.5"/></geometry>
    </visual>
    <collision><geometry><box size="1 1 1"/></geometry></collision>
  </link>
</robot>
"""
DRAWER = """<robot name="cabinet">
  <link name="body"><collision><geometry><box size="0.2 0.2 0.02"/></geometry></collision></link>
  <link name="knob">
    <collision>
      <origin xyz="0.02 0 0"/>
      <geometry><cylinder radius="0.01" length="0.04"/></geometry>
    </collision>
  </link>
  <joint name="slide" type="prismatic">
    <parent link="body"/><child link="knob"/>
    <origin xyz="0.05 0 0.03" rpy="0 0 1.5707963267948966"/>
  </joint>
</robot>
"""


def write_can(folder: Path, mesh: str = "meshes/can.stl") -> Path:
    (folder / "meshes").mkdir(exist_ok=True)
    trimesh.creation.cylinder(0.066, 0.2, sections=64).export(folder / "meshes" / "can.stl")
    (folder / "model.urdf").write_text(CAN.format(mesh=mesh))
    return folder / "model.urdf"


@pytest.mark.parametrize("mesh", ["meshes/can.stl", "package://set/can/meshes/can.stl"])
def test_the_visual_mesh_is_placed_and_scaled(tmp_path: Path, mesh: str) -> None:
    path = write_can(tmp_path, mesh)
    if "package" in mesh:  # the package is not found: the mesh is looked for beside the URDF
        (tmp_path / "can").mkdir()
        (tmp_path / "meshes").rename(tmp_path / "can" / "meshes")
    points = ik.load_surface(path).points
    assert points.min(axis=0) == pytest.approx([-0.033, -0.033, 0.05], abs=1e-3)
    assert points.max(axis=0) == pytest.approx([0.033, 0.033, 0.15], abs=1e-3)


def test_links_and_simple_shapes_make_one_body(tmp_path: Path) -> None:
    (tmp_path / "mobility.urdf").write_text(DRAWER)
    points = ik.load_surface(f"{tmp_path / 'mobility.urdf'}@0.5").points
    assert points[:, 2].max() == pytest.approx(0.025, abs=1e-3)
    knob = points[points[:, 2] > 0.006]
    assert (knob.min(axis=0) + knob.max(axis=0)) / 2 == pytest.approx(
        [0.025, 0.01, 0.0155], abs=2e-3
    )


def test_a_urdf_is_an_object_everywhere(tmp_path: Path) -> None:
    path = write_can(tmp_path)
    assert ik.load_surface(path).points[:, 2].max() == pytest.approx(0.15, abs=1e-4)
    robot = ik.load_robot("panda+panda_hand")
    pose = {"xyz": [0.5, 0.0, 0.0]}
    by_file = ik.Scene({"can": {"kind": "mesh", "file": str(path), **pose}})
    by_name = ik.Scene({"can": {"kind": "object", "object": str(path), **pose}})
    pinch = ik.Grasp({"left": ik.Contact([0.5, 0.05, 0.1])})
    clearances = [
        ik.Solver(robot, scene=scene).check(robot.home, pinch) for scene in (by_file, by_name)
    ]
    assert clearances[0] is not None
    assert clearances[1] is not None
    np.testing.assert_allclose(clearances[0].distance, clearances[1].distance, atol=1e-6)


@pytest.mark.parametrize(
    "text",
    [
        "<robot name='a'/>",
        "<sdf/>",
        "no xml",
        CAN.format(mesh="other.stl"),
        CAN.format(mesh="meshes/can.stl").replace("0.5 0.5 0.5", "0 1 1"),
        CAN.format(mesh="meshes/can.stl").replace("0 0 0.1", "a b c"),
        DRAWER.replace("length='0.04'", "").replace(' length="0.04"', ""),
    ],
)
def test_a_urdf_without_a_body_is_one_line(tmp_path: Path, text: str) -> None:
    path = write_can(tmp_path)
    path.write_text(text)
    solid = {"kind": "object", "object": str(path)}
    for load in (ik.load_surface, lambda _: ik.Scene({"can": solid})):
        with pytest.raises(ik.errors.DescriptionError) as caught:
            load(path)
        assert "model.urdf" in str(caught.value)
        assert "\n" not in str(caught.value)
