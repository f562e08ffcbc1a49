"""Capsules for a shipped arm or hand, fitted to somebody's meshes, written into its description.

    python tools/fit_shapes.py KIND NAME FILE.urdf [--names "WHAT THE FILE IS"]

The file's joints are found again by their axes at zero, so its names and frames do not matter. The
fit, and which links may touch, are those of `casadi-ik import`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from shape_fitting.links import in_our_links
from shape_fitting.writing import write

from casadi_ik.files.reading import read
from casadi_ik.files.shipped import resolve_description
from casadi_ik.integrations.importing.capsules import SHAPE_FIT, fit_links, largest_excess
from casadi_ik.integrations.importing.robot_shapes import may_touch
from casadi_ik.integrations.importing.surfaces import Surface, together
from casadi_ik.model.linkage import link_poses
from casadi_ik.model.parts import part_from_file
from casadi_ik.model.schema import ArmFile, HandFile


def main() -> None:
    """Fit and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kind", choices=("arms", "trunks", "hands"))
    parser.add_argument("name")
    parser.add_argument("file", type=Path)
    parser.add_argument("--names", default="")
    parser.add_argument("--most", type=int, default=SHAPE_FIT.max_capsules)
    parser.add_argument("--saving", type=float, default=SHAPE_FIT.min_saving)
    parser.add_argument(
        "--apart", nargs="*", default=[], help="our links that hold several of the file: each alone"
    )
    parser.add_argument("--without", nargs="*", default=[], help="links of the file to leave out")
    parser.add_argument(
        "--shapes",
        nargs="+",
        choices=("collision", "seen"),
        default=["collision"],
        help="which of the file's shapes to hold; collision: of a link without any what is seen",
    )
    given = parser.parse_args()
    path = resolve_description(given.name, given.kind)
    part = part_from_file(read(path, HandFile if given.kind == "hands" else ArmFile)[0], path)
    parts: dict[str, list[Surface]] = {}
    for wanted in given.shapes:
        found = in_our_links(part, given.file, set(given.without), seen=wanted == "seen")
        for link, some in found.items():
            parts.setdefault(link, []).extend(some)
    surfaces = {link: whole for link, some in parts.items() if (whole := together(some))}
    flat = {part.root} if given.kind == "hands" else set()
    shapes = fit_links(surfaces, flat, max_capsules=given.most, min_saving=given.saving)
    for link in given.apart:
        named = {str(i): one for i, one in enumerate(parts[link])}
        each = fit_links(named, named)
        shapes[link] = [shape for found in each.values() for shape in found]
    touching = may_touch(part, shapes, surfaces)
    write(path, shapes, touching, given.names or given.file.name)
    count = sum(map(len, shapes.values()))
    for link, found in shapes.items():
        print(f"  {link}: {len(found)}, {1e3 * largest_excess({link: found}):.0f} mm")
    print(
        f"{given.name}: {len(shapes)} links, {count} shapes, "
        f"at most {1e3 * largest_excess(shapes):.0f} mm"
    )
    print("  without:", [x for x in link_poses(part.root, part.joints, {}) if x not in shapes])
    for one in touching:
        print("  ", one.links, one.reason)


if __name__ == "__main__":
    main()
