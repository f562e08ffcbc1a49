"""Names and paths of the shipped descriptions, in the wheel or in a checkout."""

from __future__ import annotations

from pathlib import Path

from casadi_ik.errors import DescriptionError, UnknownNameError, did_you_mean

ROBOT_FILE_FORMATS = (".urdf", ".xacro", ".xml", ".mjcf")
"""File name extensions of robot files that have to be imported."""


BODIES_FOLDER = "bodies"
"""Folder of multi-arm robots."""


ROBOT_FOLDERS = ("arm_hands", BODIES_FOLDER, "arms", "hands")
"""Folders of robots and of their parts."""


def models_folder() -> Path:
    """Return the folder ``models``.

    Raises:
        DescriptionError: The installation is incomplete.
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "models", package.parent / "models"):
        if folder.is_dir():
            return folder
    raise DescriptionError(f"{package}: the shipped folder 'models' is missing; reinstall")


def shipped_names(kind: str) -> tuple[str, ...]:
    """Return the names of the shipped descriptions of a kind ("arms", "hands", "arm_hands", ...).

    Example:
        >>> ik.shipped_names("scenes")
        ('table',)
        >>> len(ik.shipped_names("arms")), len(ik.shipped_names("hands"))
        (27, 20)
    """
    return tuple(sorted(path.stem for path in (models_folder() / kind).glob("*.yaml")))


def resolve_description(
    name_or_path: str | Path, kind: str, relative_to: Path | None = None
) -> Path:
    """Return the file of a shipped name or a path.

    Args:
        name_or_path: Shipped name, or path of a YAML file (anything with a path separator or ending
            in .yaml or .yml).
        kind: Folder under ``models``.
        relative_to: File whose folder relative paths refer to; None for the working directory.

    Raises:
        UnknownNameError: No shipped description has that name.
        DescriptionError: The path does not exist.
    """
    text = str(name_or_path)
    if isinstance(name_or_path, Path) or "/" in text or text.endswith((".yaml", ".yml")):
        path = Path(text).expanduser()
        if relative_to is not None and not path.is_absolute():
            path = relative_to.parent / path
        if not path.is_file():
            problem = "is a folder, expected a YAML file" if path.is_dir() else "no such file"
            raise DescriptionError(f"{path}: {problem}")
        return path
    path = models_folder() / kind / f"{text}.yaml"
    if text not in shipped_names(kind):
        noun, names = kind.replace("_", "-").removesuffix("s"), shipped_names(kind)
        hint = did_you_mean(text, names, f"shipped: {', '.join(names)}")
        raise UnknownNameError(
            f"no shipped {noun} is called {text!r}; {hint} (or give the path of a YAML file)"
        )
    return path


def resolve_robot(
    name_or_path: str | Path, relative_to: Path | None = None
) -> Path | tuple[Path | None, Path | None]:
    """Return the file of a robot, or the files of an arm (or None) and a hand (or None).

    Args:
        name_or_path: Shipped arm-hand, multi-arm robot, arm or hand, "ARM+HAND" or "BODY+HAND" of
            shipped names, or path of a YAML file.
        relative_to: See `resolve_description`.

    Raises:
        UnknownNameError: No shipped description has that name.
        DescriptionError: The path does not exist, or is a robot file that has to be imported.
    """
    text = str(name_or_path)
    path_like = isinstance(name_or_path, Path) or "/" in text or text.endswith((".yaml", ".yml"))
    if text.endswith(ROBOT_FILE_FORMATS):
        raise DescriptionError(
            f"{text}: is a robot file; expected a description with fingertips, which casadi-ik "
            f"import {text} --out {Path(text).stem}.yaml writes"
        )
    arm, plus, hand = text.partition("+")
    if not path_like and text in shipped_names(BODIES_FOLDER):
        return resolve_description(text, BODIES_FOLDER)
    if not path_like and plus and arm in shipped_names(BODIES_FOLDER):
        return resolve_description(arm, BODIES_FOLDER), resolve_description(hand, "hands")
    arms, bodies = shipped_names("arms"), f"bodies: {', '.join(shipped_names(BODIES_FOLDER))}"
    if not path_like and plus and arm not in arms:
        listed = f"arms: {', '.join(arms)}; {bodies}"
        body = did_you_mean(text, shipped_names(BODIES_FOLDER), listed)
        raise UnknownNameError(
            f"no shipped arm or body is called {arm!r}; {did_you_mean(arm, arms, body)} (or give "
            "the path of a YAML file)"
        )
    if not path_like and plus:
        return resolve_description(arm, "arms"), resolve_description(hand, "hands")
    if not path_like and text in arms:
        return resolve_description(text, "arms"), None
    if not path_like and text in shipped_names("hands") and text not in shipped_names("arm_hands"):
        return None, resolve_description(text, "hands")
    try:
        return resolve_description(name_or_path, "arm_hands", relative_to)
    except UnknownNameError:
        names = [name for kind in ROBOT_FOLDERS for name in shipped_names(kind)]
        listed = f"shipped: {', '.join(shipped_names('arm_hands'))}; {bodies}"
        raise UnknownNameError(
            f"no shipped arm-hand is called {text!r}; {did_you_mean(text, names, listed)} (or give "
            "the path of a YAML file, or ARM+HAND of the catalogue, see casadi-ik robots)"
        ) from None
