"""Small robot with shapes of all kinds: an arm of three joints and a hand of three fingers."""

from __future__ import annotations

from pathlib import Path

import yaml

ARM = {
    "name": "three",
    "root": "base",
    "sources": {"toy": "Made up."},
    "joints": [
        {"name": "j1", "parent": "base", "child": "l1", "axis": [0, 0, 1], "limits": [-3, 3],
         "origin": {"xyz": [0, 0, 0.2]}, "source": "toy"},
        {"name": "j2", "parent": "l1", "child": "l2", "axis": [0, 1, 0], "limits": [-2, 2],
         "origin": {"xyz": [0, 0, 0.2]}, "source": "toy"},
        {"name": "j3", "parent": "l2", "child": "l3", "axis": [0, 1, 0], "limits": [-2.5, 2.5],
         "origin": {"xyz": [0.3, 0, 0]}, "source": "toy"},
    ],
    "tip": {"link": "l3", "xyz": [0.2, 0, 0], "source": "toy"},
    "collision": {
        "source": "toy",
        "links": {
            "base": [{"kind": "cylinder", "radius": 0.08, "length": 0.2, "xyz": [0, 0, 0.1]}],
            "l1": [{"kind": "capsule", "ends": [[0, 0, 0], [0, 0, 0.18]], "radius": 0.06}],
            "l2": [{"kind": "box", "size": [0.3, 0.1, 0.08], "xyz": [0.15, 0, 0],
                    "rpy": [0.2, 0.1, 0.3]}],
            "l3": [{"kind": "capsule", "ends": [[0, 0, 0], [0.15, 0, 0]], "radius": 0.04},
                   {"kind": "sphere", "center": [0.1, 0.05, 0], "radius": 0.03}],
        },
    },
}  # fmt: skip

HAND = {
    "name": "pincers",
    "root": "palm",
    "sources": {"toy": "Made up."},
    "palm": {"link": "palm", "xyz": [0.03, 0, 0], "source": "toy"},
    "thumb": "one",
    "joints": [
        {"name": f"f{i}", "parent": "palm", "child": f"tip{i}", "axis": [0, 1, 0],
         "limits": [-1.5, 1.5], "origin": {"xyz": [0.05, y, 0.02]}, "source": "toy"}
        for i, y in ((1, 0.05), (2, -0.05))
    ],
    "fingers": {
        name: {"link": f"tip{i}", "xyz": [0.08, 0, 0], "normal": [0, 0, 1], "source": "toy"}
        for i, name in ((1, "one"), (2, "two"))
    },
    "collision": {
        "source": "toy",
        "links": {
            "palm": [{"kind": "box", "size": [0.06, 0.14, 0.04], "xyz": [0.03, 0, 0]}],
            "tip1": [{"kind": "capsule", "ends": [[0, 0, 0], [0.08, 0, 0]], "radius": 0.012}],
            "tip2": [{"kind": "capsule", "ends": [[0, 0, 0], [0.08, 0, 0]], "radius": 0.012}],
        },
    },
}  # fmt: skip


def write_robot(folder: Path) -> Path:
    """Write the robot and its parts, and return the path of the robot's file."""
    (folder / "three.yaml").write_text(yaml.safe_dump(ARM))
    (folder / "pincers.yaml").write_text(yaml.safe_dump(HAND))
    top = {
        "name": "three_pincers",
        "arm": "three.yaml",
        "hand": "pincers.yaml",
        "fingers": ["one", "two"],
        "thumb": "one",
    }
    path = folder / "robot.yaml"
    path.write_text(yaml.safe_dump(top))
    return path


SCENE = {
    "table": {"kind": "box", "size": [1.0, 1.0, 0.1], "xyz": [0.7, 0, -0.1], "rpy": [0.1, 0, 0]},
    "ball": {"kind": "sphere", "radius": 0.08, "xyz": [0.3, 0.3, 0.5]},
    "pole": {"kind": "cylinder", "radius": 0.05, "length": 0.6, "xyz": [-0.3, 0.3, 0.4],
             "rpy": [0.3, 0.2, 0]},
    "stick": {"kind": "capsule", "radius": 0.03, "length": 0.3, "xyz": [0.2, -0.4, 0.4],
              "rpy": [1, 0, 0.5]},
    "floor": {"kind": "half-space", "xyz": [0, 0, -0.3], "rpy": [0.05, 0.05, 0]},
    "block": {"kind": "convex", "xyz": [-0.2, -0.4, 0.5],
              "points": [[0.1, 0, 0], [-0.1, 0.05, 0], [0, 0.12, -0.05], [0.02, -0.1, 0.06],
                         [0, 0, 0.15]]},
}  # fmt: skip
