"""The AR10: from sliders to joints by triangles and four-bars, over the whole stroke."""

from __future__ import annotations

import numpy as np
import pytest

import casadi_ik as ik
from casadi_ik import model as robots

FINGERS = ("index", "middle", "ring", "little")
SLIDERS = (
    "thumb_slider_1",
    "thumb_slider_2",
    *(f"{finger}_{phalanx}_slider" for finger in FINGERS for phalanx in ("proximal", "middle")),
)


def strokes(robot: ik.ArmHand, rows: int = 200) -> np.ndarray:
    """Return configurations with all sliders from shortest to longest."""
    return robot.lower + np.linspace(0, 1, rows)[:, None] * (robot.upper - robot.lower)


def test_ten_sliders_and_five_fingers(ar10):
    assert ar10.actuators == SLIDERS
    assert {actuator.unit for actuator in ar10.description.actuators} == {"m"}
    assert ar10.fingers == ("thumb", *FINGERS)
    assert ar10.thumb == "thumb"
    assert ar10.description.arm_actuators == ()
    for finger in FINGERS:
        assert len(ar10.description.finger_actuators(finger)) == 2
        assert len(ar10.description.finger(finger).joints) == 3


def test_published_reference_pose(ar10):
    """Chandra's code gives axes and tips at the shortest sliders, here within 4 mrad."""
    points, _ = ar10.contacts(ar10.lower)
    np.testing.assert_allclose(points[0], [-0.0927, 0.0702, 0.1023], atol=5e-5)
    np.testing.assert_allclose(points[1], [-0.0465, 0.04929, 0.22703], atol=4e-4)
    thumb = ar10.description.finger("thumb")
    pose = ar10.links(ar10.lower)[thumb.link] @ thumb.placement
    w, x, y, z = 0.905343, 0.204069, 0.187212, 0.321964
    axis_x = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    np.testing.assert_allclose(pose[:3, 0], axis_x, atol=1e-5)
    # Twice the product of the published dual part with the conjugate is the tip.
    dual = np.array([-0.0135809, -0.0402491, 0.0571297, 0.0304804])
    tip = 2 * (w * dual[1:] - dual[0] * np.array([x, y, z]) + np.cross([x, y, z], dual[1:]))
    np.testing.assert_allclose(pose[:3, 3], tip, atol=1e-6)


def test_pads_face_the_flexion_direction(ar10):
    """The normal of a pad is the direction in which flexing its last joint moves the tip."""
    for finger in ar10.description.fingers:
        rows = list(ar10.description.finger_actuators(finger.name))
        q = ar10.home.copy()
        normal = ar10.contacts(q)[1][ar10.fingers.index(finger.name)]
        last = {joint.name: joint for joint in ar10.description.movable}[finger.joints[-1]]
        link = ar10.links(q)[last.child]
        velocity = np.cross(
            link[:3, :3] @ last.axis, ar10.contacts(q)[0][rows[0] // 2] - link[:3, 3]
        )
        np.testing.assert_allclose(velocity / np.linalg.norm(velocity), normal, atol=2e-3)


def test_published_ranges(ar10):
    """Chandra's code gives 1.531 and 1.222 rad, distal 0 to 0.606; thumb 1.623, 0.848."""
    ends = ar10.joints(np.stack([ar10.lower, ar10.upper]))
    spans = {name: values[1] - values[0] for name, values in ends.items()}
    for finger in FINGERS:
        assert spans[f"{finger}_proximal"] == pytest.approx(1.531, abs=1e-3)
        assert spans[f"{finger}_middle"] == pytest.approx(1.222, abs=1e-3)
        assert ends[f"{finger}_distal"] == pytest.approx([0, 0.606], abs=1e-3)
    assert spans["thumb_1"] == pytest.approx(1.623, abs=1e-3)
    assert spans["thumb_2"] == pytest.approx(0.848, abs=1e-3)


def test_the_strokes_imply_the_joint_limits(ar10):
    joints = ar10.joints(strokes(ar10, 2000))
    for joint in ar10.description.movable:
        values = joints[joint.name]
        assert joint.lower <= values.min() < joint.lower + 2.1e-3
        assert joint.upper - 2.1e-3 < values.max() <= joint.upper


def test_toggle_margins(ar10):
    """The squared sine of the transmission angle is far from zero everywhere."""
    q = strokes(ar10)
    joints, margins = ar10.joints(q), ar10.toggle_margins(q)
    assert set(margins) == set(joints)
    for joint in ar10.description.movable:
        if isinstance(coupling := joint.coupling, robots.LeadScrew):
            sine = np.sin(joints[joint.name] + coupling.theta_0)
        elif isinstance(coupling, robots.FourBar):
            phi = coupling.phi_0 + joints[coupling.of]
            beta = phi + joints[joint.name] + coupling.theta_3_0
            pin = coupling.p * np.exp(1j * phi) + coupling.h * np.exp(1j * beta)
            sine = np.sin(beta - np.angle(pin - coupling.g))
        np.testing.assert_allclose(margins[joint.name], sine**2, atol=1e-12)
        assert margins[joint.name].min() > (0.7 if joint.name.endswith("distal") else 0.2)
    assert isinstance(ar10.toggle_margins(ar10.home)["index_distal"], float)
    assert ik.load_robot("kuka_lwr_barrett").toggle_margins(np.zeros(14)) == {}


def test_nothing_is_nan_beyond_the_toggles(ar10):
    """Beyond their strokes, sliders give flat triangles and open four-bars."""
    q = np.repeat([[0.0], [0.01], [0.0358], [0.0392], [0.0638], [0.0652], [0.1]], 10, axis=1)
    assert np.isfinite(list(ar10.joints(q).values())).all()
    assert np.isfinite(ar10.contacts(q)).all()
    margins = ar10.toggle_margins(np.full(10, 0.0392))  # b - c of the index's first triangle
    assert abs(margins["index_proximal"]) < 1e-15
    assert ar10.toggle_margins(np.full(10, 0.03))["index_proximal"] < 0
