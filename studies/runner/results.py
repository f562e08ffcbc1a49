"""The folder of a study: what is done, and that all of it belongs together."""

from __future__ import annotations

import hashlib
import json
from functools import partial
from pathlib import Path
from typing import Any

import polars as pl

from casadi_ik.batches.parts import code_version
from casadi_ik.errors import InputError
from runner.block import PART
from runner.study import Block, Study, robot_of

STUDY_FILE = "study.json"


def fingerprint(study: Study) -> dict[str, Any]:
    """Everything that decides a result, but how many there are."""
    return {
        "code": code_version(),
        "robot": _digest(robot_of(study.robot).urdf()),
        "seed": study.seed,
        "block": study.block,
        "targets": {targets.key: _name(targets.configurations) for targets in study.sets},
        "settings": {
            setting.key: {
                **study.solver(setting).parameters,
                "start": study.start(setting).tolist(),
                "robot": _digest(study.solver(setting).robot.urdf()),
            }
            for setting in study.settings
        },
    }


def claim(study: Study, folder: Path) -> None:
    """Take a folder for a study, or take it up again.

    Parts that a killed run left behind are removed; new sets and settings are added.

    Raises:
        InputError: The folder holds results that were made otherwise.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path, mine = folder / STUDY_FILE, json.loads(json.dumps(fingerprint(study), default=str))
    if path.exists():
        kept = json.loads(path.read_text(encoding="utf-8"))
        for key, value in mine.items():
            if isinstance(value, dict):
                for name, entry in value.items():
                    _same(path, f"{key}.{name}", kept[key].setdefault(name, entry), entry)
            else:
                _same(path, key, kept[key], value)
        mine = kept
    elif any(folder.iterdir()):
        raise InputError(f"{folder}: holds files but no {STUDY_FILE}, expected an empty folder")
    part = path.with_suffix(PART)
    part.write_text(json.dumps(mine, indent=1) + "\n", encoding="utf-8")
    part.replace(path)
    for left in folder.rglob(f"*{PART}"):
        left.unlink(missing_ok=True)


def missing(study: Study, folder: Path) -> list[Block]:
    """The blocks that are not there yet, or with fewer targets than are wanted now."""
    return [block for block in study.blocks() if _rows(folder / block.path) < block.size]


def _rows(path: Path) -> int:
    if not path.exists():
        return 0
    return int(pl.scan_parquet(path).select(pl.len()).collect().item())


def read_results(study: Study, folder: Path) -> pl.DataFrame:
    """Everything a study has come to so far, whatever its count; no rows if nothing."""
    paths = [
        path
        for setting in study.settings
        for group in study.sets
        for path in sorted((folder / setting.key / group.key).glob("*.parquet"))
    ]
    return pl.read_parquet(paths) if paths else pl.DataFrame()


def code_of(folder: Path) -> str | None:
    """Version of the code a folder's results were made with, if there are any."""
    path = folder / STUDY_FILE
    if not path.exists():
        return None
    return json.loads(path.read_text(encoding="utf-8"))["code"]


def _same(path: Path, key: str, found: Any, expected: Any) -> None:
    if found != expected:
        raise InputError(
            f"{path}: {key}: results made with {_brief(found)} are here, this study has "
            f"{_brief(expected)}; use another folder"
        )


def _brief(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"settings {_digest(text)}"


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _name(function: Any) -> str:
    if isinstance(function, partial):
        given = [*map(str, function.args), *(f"{k}={v}" for k, v in function.keywords.items())]
        return f"{_name(function.func)}({', '.join(given)})"
    return function.__qualname__
