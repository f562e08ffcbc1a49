"""A grasp as its file has it."""

from __future__ import annotations

import json
from typing import Any

from casadi_ik.grasps import Grasp
from casadi_ik.grasps.load import grasp_data


def grasp_text(grasp: Grasp, comment: str = "") -> str:
    """A grasp as YAML that `load_grasp` reads back to the last digit.

    Args:
        grasp: The grasp.
        comment: A line before it.
    """
    lines = [f"# {comment}"] if comment else []
    for key, value in grasp_data(grasp).items():
        if key == "contacts":
            lines.append("contacts:  # points [m] and outward normals of the pads, base frame")
            for finger, contact in value.items():
                lines += [f"  {_flow(finger)}:", *_lines(contact, "    ")]
        elif isinstance(value, dict):
            lines += [f"{key}:", *_lines(value, "  ")]
        else:
            lines.append(f"{key}: {_flow(value)}")
    return "\n".join(lines) + "\n"


def _lines(data: dict[str, Any], indent: str) -> list[str]:
    keys = {key: key if key.isidentifier() else _flow(key) for key in data}
    return [f"{indent}{keys[key]}: {_flow(value)}" for key, value in data.items()]


def _flow(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)
