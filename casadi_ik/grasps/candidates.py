"""Many grasps of one object, of which one is to be chosen."""

from __future__ import annotations

from pathlib import Path

import msgspec

from casadi_ik.errors import DescriptionError
from casadi_ik.files.reading import Struct, read, read_yaml
from casadi_ik.grasps.grasp import Grasp
from casadi_ik.grasps.load import GraspFile, ObjectEntry, grasp_of, load_grasp


class CandidatesFile(Struct, frozen=True):
    """Grasps in a list, of which one is to be chosen.

    Attributes:
        candidates: Grasps.
        robot: Of all that name no other.
        description: One sentence.
        object: Of all that name no other.
    """

    candidates: list[GraspFile]
    robot: str = ""
    description: str = ""
    object: ObjectEntry | None = None


def load_grasp_files(path: Path) -> tuple[Grasp, ...]:
    """Load grasps.

    Args:
        path: A YAML file with a list of grasps (``candidates:``) or with a single one, or a folder
            of such files, taken by their names.

    Raises:
        DescriptionError: It is missing, empty or malformed; the message names file and key.
    """
    if not path.is_dir():
        return _of_file(path)
    files = sorted(item for item in path.iterdir() if item.suffix in (".yaml", ".yml"))
    if not files:
        raise DescriptionError(f"{path}: found no YAML file, expected grasp files")
    return tuple(grasp for file in files for grasp in _of_file(file))


def _of_file(path: Path) -> tuple[Grasp, ...]:
    data = read_yaml(path)
    if not (isinstance(data, dict) and "candidates" in data):
        return (load_grasp(path),)
    file, _ = read(path, CandidatesFile)
    if not file.candidates:
        raise DescriptionError(f"{path}: candidates: found none, expected at least one grasp")
    found = []
    for i, entry in enumerate(file.candidates):
        whole = msgspec.structs.replace(
            entry, robot=entry.robot or file.robot, object=entry.object or file.object
        )
        found.append(grasp_of(whole, path, f"{path.stem}[{i}]", f"candidates[{i}]."))
    return tuple(found)
