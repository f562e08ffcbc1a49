"""Robots that cannot be imported are refused in one line with file, joint and remedy."""

from __future__ import annotations

from pathlib import Path

import pytest
from imported_files import FINGERS, describe, hand, joint, link, urdf
from processes import python

import casadi_ik as ik

BOMB = """<?xml version="1.0"?>
<!DOCTYPE robot [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>
<robot name="&b;"><link name="base_link"/></robot>
"""

TEXTS = """
</robot> => <robot>
    hand.urdf: not valid XML:
<robot name="hand"> => <html>
    hand.urdf: not valid XML: mismatched tag
type="revolute" => type="screw"
    joint 'left_spread': type: found 'screw'
child link="left_1" => child link="left_7"
    joint 'left_spread': child: link 'left_7' does not exist
<link name="left_2"/> => <link name="left_1"/>
    link 'left_1' appears twice
name="left_bend" => name="left_spread"
    joint 'left_spread' appears twice
xyz="0 0.04 0.05" => xyz="0 0.04 5cm"
    origin: xyz: found '0 0.04 5cm'
xyz="0 0.04 0.05" => xyz="0 inf 0"
    expected three finite numbers
axis xyz="0 0 1" => axis xyz="0 0 0"
    joint 'left_spread': axis: is zero
lower="-1" => lower="2"
    joint 'left_spread': limit: lower 2 is above upper 1.5
lower="-1" => lower="x"
    limit: lower: found 'x', expected a finite number
<limit lower="-1" upper="1.5" velocity="2" effort="1"/> =>
    joint 'left_spread' of link 'left_1' has no limits; write limits: {left_spread: [LOWER, UPPER]} under hand
name="left_spread" type="revolute" => name="left_spread" type="floating"
    joint 'left_spread' is floating, which has no single axis; write locked: {left_spread: 0} under hand
child link="right_1" => child link="left_1"
    joint 'right_spread': link 'left_1' has two parents; expected a tree
<link name="left_2"/> => <link name="left_2"/><link name="more"/>
    several base links (base_link, more)
joint="left_bend" => joint="elbow"
    mimics 'elbow', which is not a joint
joint="left_bend" => joint="left_end"
    mimics itself: left_end -> left_end; write locked: {left_end: 0} under hand
<link name="left_2"/> => <link/>
    a link: name: missing
"""  # noqa: E501
"""Two lines per case: the change in the hand's file, and the message."""


def pairs(text: str) -> list[tuple[str, str]]:
    lines = [line.strip() for line in text.strip().splitlines()]
    return list(zip(lines[::2], lines[1::2], strict=True))


@pytest.mark.parametrize(("change", "says"), pairs(TEXTS))
def test_refusals(tmp_path, change, says):
    path, (old, _, new) = hand(tmp_path), change.partition(" =>")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new.strip(), 1))
    message = refusal(describe(tmp_path, "hand: {file: hand.urdf}"))
    assert "hand.urdf" in message
    assert says in message


def refusal(path: Path) -> str:
    with pytest.raises(ik.errors.CasadiIKError) as caught:
        ik.load_robot(path)
    message = str(caught.value)
    assert "\n" not in message
    return message


DESCRIPTIONS = r"""
hand: {file: nothing.urdf}
    nothing.urdf: no such file
hand: {file: hand.urdf, palm: nowhere}
    hand.palm: hand.urdf: unknown link 'nowhere'; known: base_link, left_1
hand: {file: hand.urdf} / left_tip: thumb_tip
    fingers.left.link: hand.urdf: unknown link 'thumb_tip'; known: base_link
hand: {file: hand.urdf, palm: right_1}
    fingers.left.link: 'left_tip' is not below the palm 'right_1' of hand.urdf
hand: {file: hand.urdf, locked: {left_knee: 0}}
    hand.locked: hand.urdf: unknown joint 'left_knee'; known: left_spread
hand: {file: hand.urdf, root: left_1, palm: right_1}
    hand.palm: hand.urdf: link 'right_1' is not below link 'left_1'
hand: {file: hand.urdf, limits: {left_bend: [2, 1]}}
    hand.limits.left_bend: lower 2 is not below upper 1
hand: {file: hand.urdf}\nrobot: {file: hand.urdf}
    expected either 'hand' or 'robot'
hand: {file: hand.urdf} / none
    fingers: is empty
hand: {file: hand.urdf, locked: {left_spread: 0, left_bend: 0}}
    fingers.left.link: no joint moves 'left_tip' relative to the palm 'base_link'
hand: {file: hand.urdf, lokced: {}}
    lokced
hand: {file: hand.urdf}\nthumb: big
    has no finger 'big'; expected one of: left
"""
OTHER_FINGERS = {
    "": FINGERS,
    "left_tip: thumb_tip": FINGERS.replace("left_tip", "thumb_tip"),
    "none": "fingers: {}",
}


@pytest.mark.parametrize(("written", "says"), pairs(DESCRIPTIONS))
def test_refused_descriptions(tmp_path, written, says):
    text, _, fingers = written.replace(r"\n", "\n").partition(" / ")
    hand(tmp_path)
    message = refusal(describe(tmp_path, text, OTHER_FINGERS[fingers]))
    assert says in message
    assert message.startswith(str(tmp_path))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (BOMB, "has a document type (<!DOCTYPE ...>)"),
        ("<a>" * 100_000, "elements nested more than 200 deep"),
        ("<html></html>", "found <html>, expected a URDF (<robot>) or an MJCF (<mujoco>)"),
        ("<robot name='x'/>", "the base link is missing"),
        ("<robot name='x'><link name='a'/></robot>", "(1 links)"),
        ("", "not valid XML: no element found"),
        ("\xff\xfe", "not UTF-8 text"),
    ],
)
def test_hostile_files(tmp_path, text, says):
    (tmp_path / "hand.urdf").write_bytes(text.encode("latin-1"))
    assert says in refusal(describe(tmp_path, "hand: {file: hand.urdf}"))


def test_circle_of_links(tmp_path):
    circle = joint("a", "one", "two") + joint("b", "two", "one")
    urdf(tmp_path / "hand.urdf", link("base", "one", "two"), circle)
    message = refusal(describe(tmp_path, "hand: {file: hand.urdf}"))
    assert "link 'one'" in message


def test_missing_meshes_are_tolerated(tmp_path):
    mesh = '<mesh filename="package://nowhere/left.stl"/>'
    shaped = f'<link name="left_1"><visual><geometry>{mesh}</geometry></visual></link>'
    hand(tmp_path, ('<link name="left_1"/>', shaped))
    assert ik.load_robot(describe(tmp_path, "hand: {file: hand.urdf}")).fingers


@pytest.mark.parametrize(("module", "name"), [("mujoco", "x.xml"), ("xacro", "x.urdf.xacro")])
def test_formats_whose_reader_is_missing_name_the_extra(tmp_path, module, name):
    texts = {"mujoco": "<mujoco/>", "xacro": "<robot name='x'/>"}
    (tmp_path / name).write_text(texts[module])
    path = describe(tmp_path, f"hand: {{file: {name}}}")
    program = (
        f"import sys; sys.modules[{module!r}] = None\n"
        f"import casadi_ik as ik\ntry: ik.load_robot({str(path)!r})\n"
        "except ImportError as error: print(error)"
    )
    done = python("-c", program)
    assert "pip install 'casadi-ik[robots]'" in done.stdout, done


def test_unnamed_robot_is_read_without_warning(tmp_path, capfd):
    path = hand(tmp_path)
    path.write_text(path.read_text().replace('<robot name="hand">', '<robot name="">'))
    ik.load_robot(describe(tmp_path, "hand: {file: hand.urdf}"))
    assert capfd.readouterr().err == ""
