"""Every error in a description gives one line with file and key."""

from __future__ import annotations

from pathlib import Path

import pytest
from toy_robots import copy_shipped_robot, replace, write_coupled_robot

import casadi_ik as ik

CASES = r"""
robot | thumb: thumb => tumb: thumb
    (top level) | tumb
arm | axis: => achsis:
    joints[lwr_joint_1] | achsis
hand | normal: => nrmal:
    fingers.thumb | nrmal
hand | root: bh_base => #
    (top level) | `root`
robot | finger_3] => finger_4]
    fingers | no finger 'finger_4'; expected
robot | thumb: thumb => thumb: fist
    thumb | no finger 'fist'; expected
robot | [thumb, f => [f
    thumb | 'thumb' is not one
robot | finger_3] => finger_2]
    fingers | 'finger_2' appears twice
arm | [-120 deg, 120 deg] => [120 deg, -120 deg]
    joint 'lwr_joint_2': limits | lower 2.0944 is above upper -2.0944
hand | limits: [0 deg, 180 deg] => limits: [180 deg, 0 deg]
    actuators.bh_spread: limits | not below
hand | {limits: [0 deg, 180 deg], velocity: 2 rad/s, source: limits assumed} => {}
    actuators.bh_spread: limits | missing
hand | actuators:\n => actuators:\n  spare: {limits: [0, 1], source: mdh}\n
    actuators.spare | moves no joint
hand | actuators:\n => actuators:\n  bh_finger_2_spread: {}\n
    actuators.bh_finger_2_spread | 'bh_spread'
hand | 180 deg], velocity: 2 rad/s => 180 deg], velocity: 0
    actuators.bh_spread.velocity | expected > 0
hand | source: limits assumed}\n  bh_thumb_prox => }\n  bh_thumb_prox
    actuators.bh_spread: source | is empty
hand | 180 deg], velocity: 2 rad/s => 180 deg], unit: deg
    actuators.bh_spread: unit | expected 'rad' or 'm'
hand |   bh_thumb_distal: {}\n => #
    joint 'bh_thumb_distal': coupling | 'bh_thumb_distal' under 'actuators'
hand | coupling: {kind: linear, of: bh_spread} => coupling: {kind: linear, of: bh_spred}
    joint 'bh_finger_2_spread': coupling.of | unknown joint or actuator 'bh_spred'; known:
hand | coupling: {kind: linear, of: bh_spread} => coupling: {kind: wire, of: bh_spread}
    joints[bh_finger_2_spread].coupling.kind | 'wire'
hand | coupling: {kind: linear, of: bh_spread} => coupling: {kind: linear, of: bh_spread, ratio: 0}
    joint 'bh_finger_2_spread': coupling.ratio | zero
hand | coupling: {kind: linear, of: bh_spread} => coupling: {kind: linear, of: bh_finger_2_spread}
    joint 'bh_finger_2_spread': coupling.of | is a cycle bh_finger_2_spread -> bh_finger_2_spread
hand | {kind: linear, of: bh_spread} => {kind: lead-screw, of: bh_spread, b: 1, c: 2}
    joint 'bh_finger_2_spread': coupling.of | 'bh_spread' is in rad; expected a coordinate in m
hand | name: bh_thumb_distal => name: bh_thumb_proximal
    joints | 'bh_thumb_proximal' appears twice
hand | child: bh_thumb_link_3 => child: bh_thumb_link_2
    joints: child links | 'bh_thumb_link_2' appears twice
arm | child: lwr_link_1 => child: bh_base
    joint 'lwr_joint_2': parent | 'lwr_link_1' is not a link
hand | parent: bh_thumb_link_2 => parent: bh_thumb_link_7
    joint 'bh_thumb_distal': parent | 'bh_thumb_link_7' is not a link
hand | name: bh_thumb_proximal, parent: bh_base => name: bh_thumb_proximal, parent: bh_thumb_link_3
    joint 'bh_thumb_proximal': parent | 'bh_thumb_link_3' is part of a cycle
arm | axis: [0, -1, 0] => axis: [0, 0, 0]
    joint 'lwr_joint_2': axis | zero
arm | axis: [0, 0, 1], => axis: [0, 0, 1], type: hinge,
    joint 'lwr_joint_1': type | found 'hinge', expected one of revolute, prismatic, fixed
arm | velocity: 110 deg/s => velocity: -1
    joints[lwr_joint_1].velocity | found -1, expected > 0
arm | , source: centro} => }
    joints[lwr_joint_1] | `source`
arm | source: centro => source: ''
    joint 'lwr_joint_1': source | empty
arm | source: centro => source: centro myself
    joint 'lwr_joint_1': source | 'myself' is unknown; expected one of: centro, isir
hand | source: pad cad => source: guess
    fingers.thumb.source | 'guess' is unknown
arm | tip: {link: lwr_flange, source: centro} => tip: {link: lwr_flange}
    tip.source | empty
hand | palm: {link: bh_base, xyz: [0, 0, 80 mm], source: palm} => palm: {link: bh_base}
    palm.source | empty
arm | {link: lwr_flange => {link: lwr_f
    tip.link | unknown link
hand | palm: {link: bh_base => palm: {link: b
    palm.link | unknown
hand | {link: bh_thumb_link_3, xyz => {link: bh_thumb_link_9, xyz
    fingers.thumb.link | unknown link 'bh_thumb_link_9'; known: bh_base
hand | normal: [0, 1, 0] => normal: [0, 0, 0]
    fingers.thumb.normal | zero
robot | lwr_joint_4: -90 deg => lwr_joint_4: -121 deg
    home.lwr_joint_4 | -2.11185 is outside the limits [-2.0944, 2.0944]
robot | lwr_joint_4: => lwr_joint_9:
    home.lwr_joint_9 | is unknown; expected one of: lwr_joint_1
robot | bh_spread: 30 deg => bh_spread: wide
    home.bh_spread | wide
arm | 110 mm => 110 inch
    joints[lwr_joint_1].origin.xyz[2] | unknown unit 'inch'
arm | 110 mm => .nan
    joints[lwr_joint_1].origin.xyz[2] | finite
hand | joints:\n => joints: 3\nspare:\n
    joints | expected `array`
arm | limits: [-170 deg, 170 deg] => limits: [1]
    joints[lwr_joint_1].limits | 2
hand | normal: [0, 1, 0] => normal: up
    fingers.thumb.normal | found 'up'
robot | hand: hand.yaml => hand: fist
    hand | no shipped hand is called
robot | arm: arm.yaml => arm: gone.yaml
    arm | no such file
robot | name:  => name: LONG
    name | found a name of 1
hand | name: bh_thumb_distal => name: LONG
    joints | found a name of 101 characters, expected 1 to 100
robot | [thumb => [LONG
    fingers | found a name of 101 characters, expected 1 to 100
arm | velocity: 110 deg/s => velocity: 110 mm/s
    joints[lwr_joint_1].velocity | found '110 mm/s', expected rad/s
hand | 180 deg], velocity: 2 rad/s => 180 deg], velocity: 2 rad
    actuators.bh_spread.velocity | found '2 rad', expected rad/s
robot | lwr_joint_4: -90 deg => lwr_joint_4: -90 mm
    home.lwr_joint_4 | found a number in m, expected rad
robot | lwr_joint_4: -90 deg => lwr_joint_4: 1 kg
    home.lwr_joint_4 | found '1 kg', expected rad or m
arm | origin: {xyz => origin: {zyx
    joints[lwr_joint_1].origin | zyx
coupled | of: left_2, p => of: left_4, p
    joint 'left_3': coupling.of | left_3 -> left_4 -> left_3
coupled | of: left_2, p => of: screw_2, p
    joint 'left_3': coupling.of | is in m
coupled | b: 52.2 mm => b: -1
    joints[left_1].coupling.b | found -1, expected > 0
coupled | g: 0.84 cm => g: 0
    joints[left_3].coupling.g | found 0, expected > 0
coupled | p: 2.97 cm => p: 5 cm
    joint 'left_3': coupling.phi_0 | at 3.32939 rad q and h cannot span 0.0582734 m
coupled | b: 52.2 mm => b: 35 mm
    joint 'left_1': coupling | to 0.06 m, expected within |b - c| = 0.022 and b + c = 0.048
"""
"""Two lines per case: the file and the change in it, then the key and the message."""

LINES = CASES.strip().splitlines()
LONG = "x" * 101


@pytest.mark.parametrize(("change", "answer"), zip(LINES[::2], LINES[1::2], strict=True))
def test_broken_description(tmp_path: Path, change: str, answer: str) -> None:
    file, _, texts = change.replace("LONG", LONG).partition(" | ")
    old, _, new = texts.replace(r"\n", "\n").partition(" => ")
    key, _, says = answer.strip().partition(" | ")
    if file == "coupled":
        robot, path = write_coupled_robot(tmp_path), tmp_path / "parts" / "hand.yaml"
    else:
        robot, path = copy_shipped_robot(tmp_path), tmp_path / f"{file}.yaml"
    replace(path, old, new)
    with pytest.raises(ik.errors.DescriptionError) as caught:
        ik.load_robot(robot)
    message = str(caught.value)
    assert message.startswith(f"{path}: {key}: "), message
    assert says in message[len(str(path)) + len(key) :], message
    assert "\n" not in message


def test_duplicate_key(own_robot):
    replace(own_robot, "thumb: thumb", "thumb: thumb\nthumb: finger_2")
    with pytest.raises(ik.errors.DescriptionError, match=r"robot\.yaml:\d+:1: .*key 'thumb'"):
        ik.load_robot(own_robot)
