"""Capsules for a shipped arm or hand, fitted to somebody's meshes, written into its description.

    python studies/fit_shapes.py KIND NAME FILE.urdf [--names "WHAT THE FILE IS"]

The file's joints are found again by their axes at zero, so its names and frames do not matter.
Links that touch in every one of many random configurations may touch; so may those whose capsules
do and whose meshes never.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
from shape_fitting.links import in_our_links
from shape_fitting.touching import may_touch
from shape_fitting.writing import GRID, box_entry, write

from casadi_ik.arrays import Array
from casadi_ik.files.reading import read
from casadi_ik.files.shipped import resolve
from casadi_ik.importing.boxes import FittedBox, fit_boxes
from casadi_ik.importing.capsules import FittedCapsule, cut, excess, fit
from casadi_ik.importing.posture import Postures
from casadi_ik.importing.surfaces import Surface
from casadi_ik.robots.collision import capsules_of
from casadi_ik.robots.described_parts import arm_part, hand_part
from casadi_ik.robots.schema import ArmFile, HandFile

LARGE = 0.13
"""Links longer than this [m] may have more capsules than `SMALL`."""

SMALL = 2
"""Capsules of a small link, at the most."""


def held(
    triangles: Array, most: int, flat: bool
) -> tuple[list[FittedCapsule], list[FittedBox], float]:
    """Capsules that hold a mesh, or boxes where it may be flat and they hold it closer; the excess.

    Fingers come near a palm, so there flat sides matter; elsewhere capsules are quicker.
    """
    capsules, beyond = fit(triangles, most)
    boxes = fit_boxes(triangles) if flat else []
    if boxes:
        closer = excess(boxes, cut(triangles).reshape(-1, 3))
        if closer < beyond:
            return [], boxes, closer
    return [rounded(one) for one in capsules], [], beyond


def capsules_for(boxes: list[FittedBox]) -> list[FittedCapsule]:
    """The capsules that stand for boxes between links."""
    found = []
    for one in boxes:
        entry = box_entry(one)
        found += [FittedCapsule(m - h, m + h, r) for m, h, r in capsules_of(entry)]
    return found


def _large(surface: Surface) -> bool:
    return float(np.ptp(surface.points, axis=0).max()) > LARGE


def rounded(one: FittedCapsule) -> FittedCapsule:
    """The same in steps of a tenth of a millimetre, no smaller."""
    first, last = np.round(one.first * GRID) / GRID, np.round(one.last * GRID) / GRID
    return FittedCapsule(first, last, math.ceil(one.radius * GRID + 0.9) / GRID)


def main() -> None:
    """Fit and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kind", choices=("arms", "hands"))
    parser.add_argument("name")
    parser.add_argument("file", type=Path)
    parser.add_argument("--names", default="")
    parser.add_argument("--most", type=int, default=4)
    parser.add_argument("--without", nargs="*", default=[], help="links of the file to leave out")
    given = parser.parse_args()
    path = resolve(given.name, given.kind)
    if given.kind == "arms":
        part: Any = arm_part(read(path, ArmFile)[0], path)
    else:
        part = hand_part(read(path, HandFile)[0], path)
    surfaces = in_our_links(part, given.file, set(given.without))
    fitted = {
        link: held(
            one.points[one.triangles],
            given.most if _large(one) else SMALL,
            given.kind == "hands" and link == part.root,
        )
        for link, one in surfaces.items()
    }
    standing = {
        link: capsules + capsules_for(boxes) for link, (capsules, boxes, _) in fitted.items()
    }
    touching = may_touch(part, standing, surfaces)
    write(path, fitted, touching, given.names or given.file.name)
    count = sum(len(found) + len(boxes) for found, boxes, _ in fitted.values())
    worst = max(beyond for _, _, beyond in fitted.values())
    for link, (capsules, boxes, beyond) in fitted.items():
        print(f"  {link}: {len(capsules)} + {len(boxes)}, {1e3 * beyond:.0f} mm")
    print(f"{given.name}: {len(fitted)} links, {count} shapes, at most {1e3 * worst:.0f} mm beyond")
    print("  without:", [x for x in Postures(part).poses({}) if x not in fitted])
    for links, reason in touching:
        print("  ", links, reason)


if __name__ == "__main__":
    main()
