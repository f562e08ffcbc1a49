"""One block solved, and what comes of it put where it belongs."""

from __future__ import annotations

import dataclasses
import io
import os
import tempfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

import casadi_ik as ik
from casadi_ik.logs import Keep
from runner.study import Block, Study, robot_of

PART = ".part"
"""Ending of a file that is not complete."""


@dataclass(frozen=True)
class SolvedBlock:
    """A block, solved; bytes, so that a worker needs no folder in common with who asked.

    Attributes:
        block: The block.
        results: The rows, as a Parquet file.
        log: The MCAP log, if one was asked for.
    """

    block: Block
    results: bytes
    log: bytes | None


def solve_block(study: Study, block: Block, keep: Keep | None = None) -> SolvedBlock:
    """Solve a block: what a worker does.

    Args:
        study: The study.
        block: The block.
        keep: What to log; None: no log.
    """
    solver = study.ready_solver(block.setting)
    q = study.configurations(block.targets, block.number)[: block.size]
    points, normals = robot_of(study.robot).contacts(q)
    asked: dict[str, Any] = {"seed": study.seed}
    if block.setting.start:
        # Said, it is also where the solution is to be near; else the same home is a start only.
        asked["q0"] = study.start(block.setting)
    log = None
    if keep is None:
        batch = solver.solve_batch(points, normals, **asked)
    else:
        # Solves are numbered from 0 in every log; with one seed all would keep the same numbers.
        own = dataclasses.replace(keep, seed=zlib.crc32(str(block.path).encode()))
        with tempfile.TemporaryDirectory(prefix="casadi_ik-study-") as place:
            path = Path(place) / "block.mcap"
            batch = solver.solve_batch(points, normals, **asked, log=path, keep=own)
            log = path.read_bytes()
    table = io.BytesIO()
    _frame(study, block, batch, solver.robot.fingers).write_parquet(table)
    return SolvedBlock(block, table.getvalue(), log)


def store(solved: SolvedBlock, folder: Path) -> None:
    """Write what came of a block into the study's folder.

    Results appear under their name when they are complete, and after the log: a block that is
    there is there with everything.
    """
    path = folder / solved.block.path
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.stem}-{os.getpid()}{PART}")
    for content, name in ((solved.log, path.with_suffix(".mcap")), (solved.results, path)):
        if content is not None:
            part.write_bytes(content)
            part.replace(name)


def _frame(
    study: Study, block: Block, batch: ik.BatchSolution, fingers: tuple[str, ...]
) -> pl.DataFrame:
    """A row per target."""
    count = len(batch)
    columns: dict[str, Any] = {
        "study": np.full(count, study.name),
        "setting": np.full(count, block.setting.key),
        "targets": np.full(count, block.targets.key),
        "target": block.number * study.block + np.arange(count),
        "method": np.full(count, block.setting.method),
        "limits": np.full(count, block.setting.limits),
        "success": batch.success,
        "status": batch.status_names,
        "iterations": batch.iterations,
        "restarts": batch.restarts,
        "time": batch.time,
    }
    for i, finger in enumerate(fingers):
        columns[f"position_error_{finger}"] = batch.position_error[:, i]
        columns[f"angle_error_{finger}"] = batch.angle_error[:, i]
    return pl.DataFrame(columns)
