"""Table of descriptions in packages and repositories with meshes of the built-in robots."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Literal

from msgspec import Struct

from casadi_ik.compile import cache_directory
from casadi_ik.errors import InputError
from casadi_ik.files.reading import read
from casadi_ik.files.shipped import models_folder
from casadi_ik.model.description import RobotDescription


class PackageEntry(Struct, frozen=True):
    """A package or Git repository that contains descriptions of robots.

    Attributes:
        folder: Folder of the descriptions, relative to the folder of installed packages; "" for a
            repository.
        clones: Further folders that may hold them, such as the cache of `robot_descriptions`; "~"
            is the home folder.
        repository: URL of a Git repository that can be fetched.
        commit: Commit that was compared with the robots.
    """

    folder: str = ""
    clones: list[str] = []
    repository: str = ""
    commit: str = ""


class PlacedMeshEntry(Struct, frozen=True):
    """A mesh file of a link.

    Attributes:
        file: Mesh, relative to the folder of the package.
        xyz: Position of the frame of the mesh in the frame of the link [m].
        rpy: Angles of that frame about the fixed axes [rad].
        color: Colour "#rrggbb" of a mesh whose file states none.
    """

    file: str
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    color: str = ""


class VisualMeshEntry(Struct, frozen=True):
    """The description of a robot in a package, or the mesh files of its links.

    Attributes:
        package: Name of the package.
        licence: Licence of the meshes.
        file: URDF or MJCF, relative to the folder of the package. A pattern with "*" is allowed.
        base: Link of the file by link of the robot with the same frame. Fixed links of the robot
            that are one link of the file are listed one by one; the last one carries its meshes.
        joints: Joint of the file by joint of the robot. A minus sign before the name reverses the
            direction. A joint that is fixed in the robot stays at its zero in the file.
        extra: Links of the file that are drawn as well, with the nearest matched link.
        xyz: Position of the first base link of the file in that of the robot [m].
        rpy: Angles of that frame about the fixed axes [rad].
        zeros: Position of the file's joint at the zero of a joint of the robot [rad], unless zero.
        meshes: Mesh files by link of the robot, in place of a description.
    """

    package: str
    licence: str
    file: str = ""
    base: dict[str, str] = {}
    joints: dict[str, str] = {}
    extra: list[str] = []
    xyz: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0)
    zeros: dict[str, float] = {}
    meshes: dict[str, list[PlacedMeshEntry]] = {}

    @property
    def links(self) -> list[str]:
        """Links of the robot that the entry names."""
        return [*self.base, *self.meshes]

    @property
    def all_files(self) -> list[str]:
        """Description or mesh files of the entry."""
        files = [mesh.file for meshes in self.meshes.values() for mesh in meshes]
        return files or [self.file]


class CircleEntry(Struct, frozen=True):
    """A circle in the frame of a link.

    Attributes:
        xyz: Centre [m].
        radius: Radius [m].
        axis: Axis of the frame that the circle is perpendicular to.
    """

    xyz: tuple[float, float, float]
    radius: float
    axis: Literal["x", "y", "z"] = "z"


class HullEntry(Struct, frozen=True):
    """The convex hull of circles.

    Attributes:
        circles: Circles in the frame of the link.
        color: Colour "#rrggbb".
    """

    circles: list[CircleEntry]
    color: str


class MeshTable(Struct, frozen=True):
    """The content of `models/viewer/visual_meshes.yaml`.

    Attributes:
        packages: Packages by their names on the index.
        robots: Descriptions by robot, the preferred one of a robot first.
        hulls: Shapes by robot and link, for robots without a description on the machine.
    """

    packages: dict[str, PackageEntry]
    robots: dict[str, list[VisualMeshEntry]]
    hulls: dict[str, dict[str, list[HullEntry]]] = {}


def mesh_table() -> MeshTable:
    """Return the table of descriptions in other packages."""
    return read(models_folder() / "viewer" / "visual_meshes.yaml", MeshTable)[0]


def find_file(package: str, table: MeshTable, entry: VisualMeshEntry) -> Path | None:
    """Return the description of a robot in a package, or its first mesh; None if there is none."""
    first = entry.all_files[0]
    files = (path for folder in folders(package, table) for path in sorted(folder.glob(first)))
    return next((file for file in files if file.is_file()), None)


def folders(package: str, table: MeshTable) -> list[Path]:
    """Return the folders that may hold the descriptions of a package, the preferred one first."""
    candidate_folders = [fetched_folder(package)]
    candidate_folders += [Path(clone).expanduser() for clone in table.packages[package].clones]
    if table.packages[package].folder:
        with suppress(metadata.PackageNotFoundError):
            file = metadata.distribution(package).locate_file(table.packages[package].folder)
            candidate_folders.insert(0, Path(str(file)))
    return candidate_folders


def fetched_folder(package: str) -> Path:
    """Return the folder into which a repository is fetched."""
    return cache_directory() / "descriptions" / package


def candidates(
    description: RobotDescription, entries: list[VisualMeshEntry]
) -> Iterator[tuple[VisualMeshEntry, str]]:
    """Return the entries whose joints the robot has, with the prefix of the robot's names."""
    joints = {joint.name for joint in description.joints}
    for entry in entries:
        for prefix in prefixes(description, entry.links):
            if {prefix + name for name in entry.joints} <= joints:
                yield entry, prefix


def prefixes(description: RobotDescription, links: Sequence[str]) -> list[str]:
    """Return the prefixes with which a robot has all the given links."""
    names = set(description.links)
    possible = [name.removesuffix(links[0]) for name in names if name.endswith(links[0])]
    return sorted(prefix for prefix in possible if {prefix + link for link in links} <= names)


def covered_links(description: RobotDescription, entry: VisualMeshEntry, prefix: str) -> set[str]:
    """Return the links of the robot that an entry draws."""
    names = {prefix + name for name in entry.joints}
    children = {joint.child for joint in description.joints if joint.name in names}
    return children | {prefix + link for link in entry.links}


def fetch_repository(package: str, table: MeshTable) -> Path:
    """Fetch the folders of a Git repository that the table names, and return where they are.

    A folder that was fetched earlier is replaced.

    Raises:
        InputError: The package has no repository, or Git cannot fetch it.
    """
    source, target = table.packages[package], fetched_folder(package)
    if not source.repository:
        raise InputError(f"{package}: package is on the index; expected: pip install {package}")
    entries = [entry for entries in table.robots.values() for entry in entries]
    files = [file for entry in entries if entry.package == package for file in entry.all_files]
    sparse = sorted({f"/{Path(file).parent.as_posix()}/" for file in files})
    target.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(dir=target.parent))
    try:
        for command in (
            ["init", "--quiet"],
            ["remote", "add", "origin", source.repository],
            ["sparse-checkout", "set", "--no-cone", *sparse],
            ["fetch", "--quiet", "--depth", "1", "--filter=blob:none", "origin", source.commit],
            ["checkout", "--quiet", "FETCH_HEAD"],
        ):
            _git(folder, command)
        shutil.rmtree(target, ignore_errors=True)
        folder.replace(target)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return target


def _git(folder: Path, arguments: list[str]) -> None:
    try:
        subprocess.run(
            ["git", "-C", str(folder), *arguments], check=True, capture_output=True, text=True
        )
    except OSError as error:
        raise InputError(f"git: program cannot start: {error}") from error
    except subprocess.CalledProcessError as error:
        lines = error.stderr.strip().splitlines() or [f"exit code {error.returncode}"]
        raise InputError(f"git {arguments[0]}: {lines[-1]}") from error
