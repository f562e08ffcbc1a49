"""Every way to break a description gives one line that names file and key."""

from __future__ import annotations

import pytest
from toy_robots import replace, write_coupled_robot

import casadi_ik as ik

THUMB_ORIGIN = "origin: {xyz: [0, 50 mm, 75.4 mm], rpy: [90 deg, -2.456 deg, 90 deg]}"
COUPLED = "coupling: {kind: linear, of: bh_spread}"
ARM_TIP = "tip: {link: lwr_flange, source: centro}"
PALM = "palm: {link: bh_base, xyz: [0, 0, 80 mm], source: palm}"

SHIPPED = {
    # name: (file, text, its replacement, the key, what is said)
    "unknown key, robot": ("robot", "thumb: thumb", "tumb: thumb", "(top level)", "tumb"),
    "unknown key, joint": ("arm", "axis:", "achsis:", "joints[lwr_joint_1]", "achsis"),
    "unknown key, contact": ("hand", "normal:", "nrmal:", "fingers.thumb", "nrmal"),
    "missing key": ("hand", "root: bh_base", "", "(top level)", "`root`"),
    "missing finger": (
        "robot",
        "finger_3]",
        "finger_4]",
        "fingers",
        "no finger 'finger_4'; it has",
    ),
    "missing thumb": ("robot", "thumb: thumb", "thumb: fist", "thumb", "no finger 'fist'; it has"),
    "thumb left out": ("robot", "[thumb, ", "[", "thumb", "not among the fingers"),
    "finger twice": ("robot", "finger_3]", "finger_2]", "fingers", "'finger_2' appears twice"),
    "arm joint limits": (
        "arm",
        "[-120 deg, 120 deg]",
        "[120 deg, -120 deg]",
        "joint 'lwr_joint_2': limits",
        "lower 2.0944 is above upper -2.0944",
    ),
    "actuator limits": (
        "hand",
        "limits: [0 deg, 180 deg]",
        "limits: [180 deg, 0 deg]",
        "actuators.bh_spread: limits",
        "not below",
    ),
    "actuator without limits": (
        "hand",
        "{limits: [0 deg, 180 deg], velocity: 2 rad/s, source: limits assumed}",
        "{}",
        "actuators.bh_spread: limits",
        "missing",
    ),
    "actuator that moves nothing": (
        "hand",
        "actuators:\n",
        "actuators:\n  spare: {limits: [0, 1], source: mdh}\n",
        "actuators.spare",
        "moves nothing",
    ),
    "actuator of a follower": (
        "hand",
        "actuators:\n",
        "actuators:\n  bh_finger_2_spread: {}\n",
        "actuators.bh_finger_2_spread",
        "follows 'bh_spread' already",
    ),
    "actuator velocity": (
        "hand",
        "180 deg], velocity: 2 rad/s",
        "180 deg], velocity: 0",
        "actuators.bh_spread: velocity",
        "expected > 0",
    ),
    "actuator without source": (
        "hand",
        "velocity: 2 rad/s, source: limits assumed}\n  bh_thumb_prox",
        "velocity: 2 rad/s}\n  bh_thumb_prox",
        "actuators.bh_spread: source",
        "is empty",
    ),
    "actuator unit": (
        "hand",
        "180 deg], velocity: 2 rad/s",
        "180 deg], unit: deg",
        "actuators.bh_spread: unit",
        "expected 'rad' or 'm'",
    ),
    "joint without a motor": (
        "hand",
        "  bh_thumb_distal: {}\n",
        "",
        "joint 'bh_thumb_distal': coupling",
        "no 'bh_thumb_distal' under 'actuators'",
    ),
    "coupling of an unknown joint": (
        "hand",
        COUPLED,
        "coupling: {kind: linear, of: bh_spred}",
        "joint 'bh_finger_2_spread': coupling.of",
        "unknown joint or actuator 'bh_spred'; known: bh_thumb_proximal",
    ),
    "coupling kind": (
        "hand",
        COUPLED,
        "coupling: {kind: wire, of: bh_spread}",
        "joints[bh_finger_2_spread].coupling.kind",
        "'wire'",
    ),
    "coupling ratio": (
        "hand",
        COUPLED,
        "coupling: {kind: linear, of: bh_spread, ratio: 0}",
        "joint 'bh_finger_2_spread': coupling.ratio",
        "zero",
    ),
    "coupling on itself": (
        "hand",
        COUPLED,
        "coupling: {kind: linear, of: bh_finger_2_spread}",
        "joint 'bh_finger_2_spread': coupling.of",
        "is a cycle bh_finger_2_spread -> bh_finger_2_spread",
    ),
    "lead screw of an angle": (
        "hand",
        COUPLED,
        "coupling: {kind: lead-screw, of: bh_spread, b: 1, c: 2}",
        "joint 'bh_finger_2_spread': coupling.of",
        "'bh_spread' is in rad, expected something in m",
    ),
    "joint twice": (
        "hand",
        "name: bh_thumb_distal",
        "name: bh_thumb_proximal",
        "joints",
        "'bh_thumb_proximal' appears twice",
    ),
    "link twice": (
        "hand",
        "child: bh_thumb_link_3",
        "child: bh_thumb_link_2",
        "joints: child links",
        "'bh_thumb_link_2' appears twice",
    ),
    "link of arm and hand": (
        "arm",
        "child: lwr_link_1",
        "child: bh_base",
        "joint 'lwr_joint_2': parent",
        "'lwr_link_1' is no link",
    ),
    "unknown parent": (
        "hand",
        "parent: bh_thumb_link_2",
        "parent: bh_thumb_link_7",
        "joint 'bh_thumb_distal': parent",
        "'bh_thumb_link_7' is no link",
    ),
    "frame cycle": (
        "hand",
        "name: bh_thumb_proximal, parent: bh_base",
        "name: bh_thumb_proximal, parent: bh_thumb_link_3",
        "joint 'bh_thumb_proximal': parent",
        "'bh_thumb_link_3' is part of a frame cycle",
    ),
    "zero axis": (
        "arm",
        "axis: [0, -1, 0]",
        "axis: [0, 0, 0]",
        "joint 'lwr_joint_2': axis",
        "zero",
    ),
    "joint type": (
        "arm",
        "axis: [0, 0, 1],",
        "axis: [0, 0, 1], type: hinge,",
        "joint 'lwr_joint_1': type",
        "found 'hinge', expected one of revolute, prismatic, fixed",
    ),
    "joint velocity": (
        "arm",
        "velocity: 110 deg/s",
        "velocity: -1",
        "joint 'lwr_joint_1': velocity",
        "expected > 0",
    ),
    "missing source": ("arm", ", source: centro}", "}", "joints[lwr_joint_1]", "`source`"),
    "empty source": ("arm", "source: centro", "source: ''", "joint 'lwr_joint_1': source", "empty"),
    "unknown source": (
        "arm",
        "source: centro",
        "source: centro myself",
        "joint 'lwr_joint_1': source",
        "unknown tag 'myself'; sources: centro, isir",
    ),
    "source of a contact": (
        "hand",
        "source: pad cad",
        "source: guess",
        "fingers.thumb.source",
        "unknown tag 'guess'",
    ),
    "source of the tip": ("arm", ARM_TIP, "tip: {link: lwr_flange}", "tip.source", "empty"),
    "source of the palm": ("hand", PALM, "palm: {link: bh_base}", "palm.source", "empty"),
    "link of the tip": ("arm", "{link: lwr_flange", "{link: lwr_f", "tip.link", "unknown link"),
    "link of the palm": ("hand", "palm: {link: bh_base", "palm: {link: b", "palm.link", "unknown"),
    "link of a contact": (
        "hand",
        "{link: bh_thumb_link_3, xyz",
        "{link: bh_thumb_link_9, xyz",
        "fingers.thumb.link",
        "unknown link 'bh_thumb_link_9'; known: bh_base",
    ),
    "zero normal": (
        "hand",
        "normal: [0, 1, 0]",
        "normal: [0, 0, 0]",
        "fingers.thumb.normal",
        "zero",
    ),
    "home out of limits": (
        "robot",
        "lwr_joint_4: -90 deg",
        "lwr_joint_4: -121 deg",
        "home.lwr_joint_4",
        "-2.11185 is outside the limits [-2.0944, 2.0944]",
    ),
    "home of a stranger": (
        "robot",
        "lwr_joint_4:",
        "lwr_joint_9:",
        "home.lwr_joint_9",
        "no such actuator; known: lwr_joint_1",
    ),
    "home is no number": (
        "robot",
        "bh_spread: 30 deg",
        "bh_spread: wide",
        "home.bh_spread",
        "wide",
    ),
    "unknown unit": (
        "arm",
        "110 mm",
        "110 inch",
        "joints[lwr_joint_1].origin.xyz[2]",
        "unknown unit 'inch'",
    ),
    "not finite": ("arm", "110 mm", ".nan", "joints[lwr_joint_1].origin.xyz[2]", "finite"),
    "wrong type": ("hand", "joints:\n", "joints: 3\nspare:\n", "joints", "expected `array`"),
    "wrong length": (
        "arm",
        "limits: [-170 deg, 170 deg]",
        "limits: [1]",
        "joints[lwr_joint_1].limits",
        "2",
    ),
    "wrong type in contact": (
        "hand",
        "normal: [0, 1, 0]",
        "normal: up",
        "fingers.thumb.normal",
        "found 'up'",
    ),
    "unknown hand": ("robot", "hand: hand.yaml", "hand: fist", "hand", "no shipped hand is called"),
    "missing arm file": ("robot", "arm: arm.yaml", "arm: gone.yaml", "arm", "no such file"),
    "long name, robot": (
        "robot",
        "name: ",
        f"name: {'x' * 101}",
        "name",
        "found a name of 1",
    ),
    "long name, joint": (
        "hand",
        "name: bh_thumb_distal",
        f"name: {'x' * 101}",
        "joints",
        "found a name of 101 characters, expected 1 to 100",
    ),
    "long name, finger": (
        "robot",
        "[thumb, ",
        f"[{'x' * 101}, ",
        "fingers",
        "found a name of 101 characters, expected 1 to 100",
    ),
    "unit of a joint's velocity": (
        "arm",
        "velocity: 110 deg/s",
        "velocity: 110 mm/s",
        "joints[lwr_joint_1].velocity",
        "found '110 mm/s', expected rad/s",
    ),
    "unit of an actuator's velocity": (
        "hand",
        "180 deg], velocity: 2 rad/s",
        "180 deg], velocity: 2 rad",
        "actuators.bh_spread.velocity",
        "found '2 rad', expected rad/s",
    ),
    "unit of home, a length": (
        "robot",
        "lwr_joint_4: -90 deg",
        "lwr_joint_4: -90 mm",
        "home.lwr_joint_4",
        "found a number in m, expected rad",
    ),
    "unit of home, a mass": (
        "robot",
        "lwr_joint_4: -90 deg",
        "lwr_joint_4: 1 kg",
        "home.lwr_joint_4",
        "found '1 kg', expected rad or m",
    ),
    "frame key": ("arm", "origin: {xyz", "origin: {zyx", "joints[lwr_joint_1].origin", "zyx"),
}


@pytest.mark.parametrize("case", SHIPPED)
def test_broken_shipped_robot(own_robot, case):
    file, old, new, key, says = SHIPPED[case]
    path = own_robot.with_name(f"{file}.yaml")
    replace(path, old, new)
    with pytest.raises(ik.errors.DescriptionError) as caught:
        ik.load_robot(own_robot)
    message = str(caught.value)
    assert message.startswith(f"{path}: {key}: "), message
    assert says in message[len(str(path)) + len(key) :], message
    assert "\n" not in message


def test_duplicate_key(own_robot):
    replace(own_robot, "thumb: thumb", "thumb: thumb\nthumb: finger_2")
    with pytest.raises(
        ik.errors.DescriptionError, match=r"robot\.yaml:\d+:1: .*key 'thumb' appears twice"
    ):
        ik.load_robot(own_robot)


COUPLINGS = {
    "cycle": (
        "of: left_2, p",
        "of: left_4, p",
        "'left_3': coupling.of",
        "left_3 -> left_4 -> left_3",
    ),
    "four-bar of a slider": ("of: left_2, p", "of: screw_2, p", "'left_3': coupling.of", "is in m"),
    "lead-screw side": ("b: 52.2 mm", "b: -1", "'left_1': coupling.b", "expected > 0"),
    "four-bar side": ("g: 0.84 cm", "g: 0", "'left_3': coupling.g", "expected > 0"),
    "four-bar that does not close": (
        "p: 2.97 cm",
        "p: 5 cm",
        "'left_3': coupling.phi_0",
        "at 3.32939 rad q and h cannot span 0.0582734 m",
    ),
    "slider beyond its triangle": (
        "b: 52.2 mm",
        "b: 35 mm",
        "'left_1': coupling",
        "'screw_1' goes from 0.042 to 0.06 m, expected within |b - c| = 0.022 and b + c = 0.048 m",
    ),
}


@pytest.mark.parametrize("case", COUPLINGS)
def test_broken_coupling(tmp_path, case):
    old, new, key, says = COUPLINGS[case]
    path = write_coupled_robot(tmp_path)
    replace(tmp_path / "parts" / "hand.yaml", old, new)
    with pytest.raises(ik.errors.DescriptionError) as caught:
        ik.load_robot(path)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'parts' / 'hand.yaml'}: joint {key}: "), message
    assert says in message


def test_unknown_robot_lists_the_shipped():
    with pytest.raises(
        ik.errors.UnknownNameError, match=r"no shipped arm-hand is called 'pr2'.*kuka_lwr_barr"
    ):
        ik.load_robot("pr2")
    with pytest.raises(ik.errors.DescriptionError, match=r"my/robot\.yaml: no such file"):
        ik.load_robot("my/robot.yaml")
