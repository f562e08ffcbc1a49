"""The folder of a batch in parts: what is done, and that all of it belongs together."""

from __future__ import annotations

import json
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from casadi_ik.batches.part import SolvedPart
from casadi_ik.errors import InputError
from casadi_ik.files.writing import tidy, written_whole

MANIFEST = "batch.json"
FORMAT = 1


class BatchFolder:
    """Parts of one batch.

    A part is there whole or not at all: whoever is killed loses what was being solved.

    Attributes:
        path: The folder.
        logs: The folder of the logs, one per part; None: there are none.
    """

    def __init__(self, path: Path, logs: Path | None = None) -> None:
        self.path, self.logs = path, logs

    def part(self, number: int) -> Path:
        """Where the answers of a part stand."""
        return self.path / f"part-{number:06d}.npz"

    def log(self, number: int) -> Path:
        """Where its log stands."""
        assert self.logs is not None
        return self.logs / f"part-{number:06d}.mcap"

    def claim(self, question: Mapping[str, Any], resume: bool) -> None:
        """Take the folder for a batch, or go on with it.

        Args:
            question: Everything that decides the answers, as JSON holds it.
            resume: Whether parts may be there already.

        Raises:
            InputError: It holds something else, or parts though `resume` is false.
            OSError: It cannot be written.
        """
        mine = json.loads(json.dumps({"format": FORMAT, **question}))
        path = self.path / MANIFEST
        if path.exists():
            kept = self._read(path)
            for key, value in mine.items():
                if kept.get(key) != value:
                    raise InputError(
                        f"{path}: {key}: these parts were made with {_brief(kept.get(key))}, this "
                        f"batch has {_brief(value)}; expected the same, or another --out"
                    )
            if not resume:
                raise InputError(
                    f"{self.path}: holds parts of this batch, expected --resume to go on with "
                    "them, or another --out"
                )
        elif self.path.is_dir() and any(self.path.iterdir()):
            raise InputError(f"{self.path}: holds files but no {MANIFEST}, expected a new folder")
        for folder in filter(None, (self.path, self.logs)):
            folder.mkdir(parents=True, exist_ok=True)
            tidy(folder, ".part-*")
        if not path.exists():
            with written_whole(path) as part:
                part.write_text(json.dumps(mine, indent=1) + "\n", encoding="utf-8")

    def done(self) -> set[int]:
        """Numbers of the parts that are there."""
        return {
            int(path.stem.removeprefix("part-"))
            for path in self.path.glob("part-*.npz")
            if path.stem.removeprefix("part-").isdigit()
        }

    def store(self, solved: SolvedPart) -> None:
        """Put what came of a part into its place: the log first, so that what is there is whole.

        Raises:
            OSError: It cannot be written.
        """
        if solved.log is not None:
            with written_whole(self.log(solved.number)) as part:
                part.write_bytes(solved.log)
        with written_whole(self.part(solved.number)) as part:
            part.write_bytes(solved.answers)

    def answers(self, number: int, first_row: int, count: int) -> dict[str, np.ndarray]:
        """The arrays of a part.

        Args:
            number: Of the part.
            first_row: Number of its first target among all.
            count: Targets of it.

        Raises:
            InputError: Its file is damaged, or has the answers to other targets.
        """
        arrays = self._arrays(number)
        rows = arrays.pop("row", np.zeros(0))
        if not np.array_equal(rows, first_row + np.arange(count)):
            found = f"{len(rows)} targets from {rows[0]} on" if len(rows) else "no row"
            raise InputError(
                f"{self.part(number)}: row: found {found}, expected {count} targets from "
                f"{first_row} on; remove it and go on"
            )
        return arrays

    def _arrays(self, number: int) -> dict[str, np.ndarray]:
        path = self.part(number)
        try:
            with np.load(path, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise InputError(f"{path}: damaged ({error}); remove it and go on") from error

    def remove(self) -> None:
        """Remove the parts and the folder, if there is nothing else in it."""
        for number in self.done():
            self.part(number).unlink()
        (self.path / MANIFEST).unlink()
        if not any(self.path.iterdir()):
            self.path.rmdir()

    def _read(self, path: Path) -> dict[str, Any]:
        try:
            kept = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be read: {error}") from error
        if not isinstance(kept, dict):
            raise InputError(f"{path}: found {type(kept).__name__}, expected an object")
        return kept


def _brief(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else f"{text[:70]}..."
