"""Fit collision shapes of a built-in arm or hand to meshes and write them to its description.

    python tools/fit_shapes.py KIND NAME FILE.urdf [--names "WHAT THE FILE IS"]

Joints of the file are matched by their axes at zero, so names and frames may differ. The fit and
the pairs of links that may touch are computed as by `casadi-ik import`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from shape_fitting.links import in_our_links
from shape_fitting.writing import write

from casadi_ik.files.reading import read
from casadi_ik.files.shipped import resolve_description
from casadi_ik.integrations.importing.capsules import SHAPE_FIT, fit_links, largest_excess
from casadi_ik.integrations.importing.meshes import IndexedMesh, merge_meshes
from casadi_ik.integrations.importing.robot_shapes import allowed_overlaps
from casadi_ik.model.joints import link_poses
from casadi_ik.model.parts import part_from_file
from casadi_ik.model.schema import ArmFile, HandFile


def main() -> None:
    """Fit the shapes and write the description."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("kind", choices=("arms", "trunks", "hands"))
    parser.add_argument("name")
    parser.add_argument("file", type=Path)
    parser.add_argument("--names", default="")
    parser.add_argument("--most", type=int, default=SHAPE_FIT.max_capsules)
    parser.add_argument("--saving", type=float, default=SHAPE_FIT.min_saving)
    parser.add_argument(
        "--apart",
        nargs="*",
        default=[],
        help="links with several links of the file: fit each separately",
    )
    parser.add_argument("--without", nargs="*", default=[], help="links of the file to ignore")
    parser.add_argument(
        "--shapes",
        nargs="+",
        choices=("collision", "seen"),
        default=["collision"],
        help="shapes of the file to enclose; collision: visual shapes of links without any",
    )
    options = parser.parse_args()
    path = resolve_description(options.name, options.kind)
    part = part_from_file(read(path, HandFile if options.kind == "hands" else ArmFile)[0], path)
    parts: dict[str, list[IndexedMesh]] = {}
    for kind in options.shapes:
        by_link = in_our_links(part, options.file, set(options.without), visual=kind == "seen")
        for link, surfaces_of_link in by_link.items():
            parts.setdefault(link, []).extend(surfaces_of_link)
    surfaces = {
        link: mesh
        for link, surfaces_of_link in parts.items()
        if (mesh := merge_meshes(surfaces_of_link))
    }
    flat = {part.root} if options.kind == "hands" else set()
    shapes = fit_links(surfaces, flat, max_capsules=options.most, min_saving=options.saving)
    for link in options.apart:
        pieces = {str(i): surface for i, surface in enumerate(parts[link])}
        fitted = fit_links(pieces, pieces)
        shapes[link] = [shape for group in fitted.values() for shape in group]
    touching = allowed_overlaps(part, shapes, surfaces)
    write(path, shapes, touching, options.names or options.file.name)
    count = sum(map(len, shapes.values()))
    for link, fitted_shapes in shapes.items():
        print(
            f"  {link}: {len(fitted_shapes)}, {1e3 * largest_excess({link: fitted_shapes}):.0f} mm"
        )
    print(
        f"{options.name}: {len(shapes)} links, {count} shapes, "
        f"at most {1e3 * largest_excess(shapes):.0f} mm"
    )
    print("  without:", [x for x in link_poses(part.root, part.joints, {}) if x not in shapes])
    for pair in touching:
        print("  ", pair.links, pair.reason)


if __name__ == "__main__":
    main()
