"""Small robot files in other formats, with one obstacle each."""

from __future__ import annotations

from pathlib import Path

FINGERS = """
fingers:
  left: {link: left_tip, xyz: [0, -0.01, 0.03], normal: [0, -1, 0]}
  right: {link: right_tip, xyz: [0, 0.01, 0.03], normal: [0, 1, 0]}
"""


def link(*names: str, content: str = "") -> str:
    end = f">{content}</link>" if content else "/>"
    return "".join(f'<link name="{name}"{end}\n' for name in names)


def joint(
    name: str,
    parent: str,
    child: str,
    kind: str = "revolute",
    *,
    xyz: str = "0 0.01 0.1",
    rpy: str = "0 0 0",
    axis: str = "1 0 0",
    limit: str = 'lower="-1" upper="1.5" velocity="2" effort="1"',
    attributes: str = "",
) -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    origin = f'<origin xyz="{xyz}" rpy="{rpy}"/>'
    axis_ = f'<axis xyz="{axis}"/>' if kind not in ("fixed", "floating") else ""
    limit_ = f"<limit {limit}/>" if limit and kind in ("revolute", "prismatic") else ""
    return f'<joint name="{name}" type="{kind}">{origin}{ends}{axis_}{limit_}{attributes}</joint>\n'


def urdf(path: Path, *parts: str) -> Path:
    path.write_text(f'<robot name="{path.stem}">\n{"".join(parts)}</robot>\n')
    return path


def hand(folder: Path, *changes: tuple[str, str], name: str = "hand.urdf") -> Path:
    """Write a hand of two fingers with three joints each, the last one coupled; with changes."""
    text = link("base_link", *(f"{s}_{n}" for s in ("left", "right") for n in ("1", "2", "tip")))
    for side, place, turn in (("left", "0 0.04 0.05", "0.1"), ("right", "0 -0.04 0.05", "3.2")):
        rpy = f"0.05 0 {turn}"
        text += joint(f"{side}_spread", "base_link", f"{side}_1", xyz=place, rpy=rpy, axis="0 0 1")
        text += joint(f"{side}_bend", f"{side}_1", f"{side}_2", axis="1 0.2 0")
        mimic = f'<mimic joint="{side}_bend" multiplier="0.5" offset="0.1"/>'
        text += joint(f"{side}_end", f"{side}_2", f"{side}_tip", xyz="0 0 0.04", attributes=mimic)
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    return urdf(folder / name, text)


def arm(folder: Path, joints: int = 6, name: str = "arm.urdf") -> Path:
    """Write an arm of some joints on alternating axes, whose first link is base_link as well."""
    links = ["base_link", *(f"arm_{i}" for i in range(1, joints + 1)), "flange"]
    text = link(*links)
    for i in range(joints):
        axis = ("0 0 1", "0 1 0", "0 1 0", "1 0 0")[i % 4]
        text += joint(
            f"joint_{i + 1}",
            links[i],
            links[i + 1],
            xyz="0.02 0 0.2",
            axis=axis,
            rpy=f"0 0.1 0.{i}",
        )
    text += joint("flange_fixed", links[joints], "flange", "fixed", xyz="0 0 0.05", rpy="0 0.3 0")
    return urdf(folder / name, text)


def describe(folder: Path, text: str, fingers: str = FINGERS) -> Path:
    path = folder / "robot.yaml"
    path.write_text(f"name: imported\n{text}\n{fingers}")
    return path
