"""Pages for several tests, each built once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

import casadi_ik as ik
from casadi_ik.app import viewer as viewing

URDF = """<robot name="hand"><link name="palm"/>
{links}</robot>"""

FINGER = """<link name="{name}_1"/><link name="{name}_2"><collision><origin xyz="0 0 0.02"/>
<geometry><box size="0.02 0.016 0.04"/></geometry></collision></link><link name="{name}_tip"/>
<joint name="{name}_a" type="revolute"><origin xyz="0 {y} 0.05"/><parent link="palm"/>
<child link="{name}_1"/><axis xyz="{x} 0 0"/><limit lower="0" upper="1.5" velocity="1" effort="1"/>
</joint><joint name="{name}_b" type="revolute"><origin xyz="0 0 0.04"/><parent link="{name}_1"/>
<child link="{name}_2"/><axis xyz="{x} 0 0"/><limit lower="0" upper="1.5" velocity="1" effort="1"/>
</joint><joint name="{name}_c" type="fixed"><origin xyz="0 0 0.04" rpy="0.3 0 0"/>
<parent link="{name}_2"/><child link="{name}_tip"/></joint>"""

YAML = """# Made by somebody
name: my_hand
hand: {file: hand.urdf, palm: palm}  # a comment that stays
fingers:  # xyz [m]
  # GUESS: where a ray meets the shape
  first: {link: first_tip, xyz: [0, 0.01, -0.01], normal: [0, 1, 0]}
  second:
    link: second_2
    rpy: [0, 0, 90 deg]
    normal: [1, 0, 0]
"""


@pytest.fixture(scope="session")
def cup_viewer(robot: ik.ArmHand) -> Iterator[viewing.Viewer]:
    """Page of the cup with the shipped robot and a table."""
    viewer = viewing.view_grasp(robot, ik.load_grasp("cup"), scene=ik.load_scene("table"))
    yield viewer
    viewer.stop()


@pytest.fixture
def cup(cup_viewer: viewing.Viewer) -> Iterator[viewing.Viewer]:
    """The page of the cup in its initial state."""
    cup_viewer.page.reset()
    assert cup_viewer.page.work.settle(300)
    yield cup_viewer
    cup_viewer.page.work.settle(300)


@pytest.fixture
def description(tmp_path: Path) -> Path:
    """Description of a hand of two fingers with guessed pads."""
    fingers = (("first", -0.04, -1), ("second", 0.04, 1))
    links = "".join(FINGER.format(name=name, y=y, x=x) for name, y, x in fingers)
    (tmp_path / "hand.urdf").write_text(URDF.format(links=links))
    path = tmp_path / "my_hand.yaml"
    path.write_text(YAML)
    return path


@pytest.fixture
def pads(description: Path) -> Iterator[viewing.Viewer]:
    """Page of these pads."""
    viewer = viewing.view_pads(description)
    yield viewer
    viewer.stop()
