"""A grasp as its file has it."""

from __future__ import annotations

import json

import numpy as np

from casadi_ik.arrays import Array
from casadi_ik.files.reading import roll_pitch_yaw
from casadi_ik.grasps import Contact, Grasp


def grasp_text(grasp: Grasp, comment: str = "") -> str:
    """A grasp as YAML that `load_grasp` reads back to the last digit.

    Args:
        grasp: The grasp.
        comment: A line before it.
    """
    lines = [f"# {comment}"] if comment else []
    if grasp.robot:
        lines.append(f"robot: {json.dumps(grasp.robot, ensure_ascii=False)}")
    if grasp.object:
        lines += ["object:", f"  name: {json.dumps(grasp.object, ensure_ascii=False)}"]
        if grasp.object_pose is not None:
            turn = roll_pitch_yaw(grasp.object_pose[:3, :3])
            xyz = _vector(grasp.object_pose[:3, 3])
            lines.append(f"  pose: {{xyz: {xyz}, rpy: {_vector(turn)}}}")
    lines.append("contacts:  # points [m] and outward normals of the pads, robot's base frame")
    for finger, contact in grasp.contacts.items():
        lines.append(f"  {json.dumps(finger, ensure_ascii=False)}:")
        lines += [f"    {line}" for line in _contact(contact)]
    return "\n".join(lines) + "\n"


def _contact(contact: Contact) -> list[str]:
    if np.isnan(contact.point).any():
        assert contact.normal is not None
        lines = [f"direction: {_vector(contact.normal)}"]
    else:
        lines = [f"point: {_vector(contact.point)}"]
        for name in ("normal", "tangent", "line", "plane"):
            vector = getattr(contact, name)
            if vector is not None:
                lines.append(f"{name}: {_vector(vector)}")
    if contact.tolerance is not None:
        position, angle = contact.tolerance.position, contact.tolerance.angle
        lines.append(f"tolerance: {{position: {float(position)!r}, angle: {float(angle)!r}}}")
    return lines


def _vector(values: Array) -> str:
    return f"[{', '.join(repr(float(value) + 0.0) for value in values)}]"
