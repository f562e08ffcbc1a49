"""One block solved and written: what a worker does."""

from __future__ import annotations

import dataclasses
import os
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

import casadi_ik as ik
from casadi_ik.logs import Keep
from runner.study import Block, Study, robot_of

PART = ".part"
"""Ending of a file that is not complete."""


def solve_block(study: Study, block: Block, folder: Path, keep: Keep | None = None) -> None:
    """Solve a block and write its results, with its log if asked for.

    Results appear under their name when they are complete, and after the log: a block that is
    there is there with everything.

    Args:
        study: The study.
        block: The block.
        folder: The study's folder.
        keep: What to log, in one file per block; None: no log.
    """
    solver = study.solver(block.setting)
    q = study.configurations(block.targets, block.number)
    points, normals = robot_of(study.robot).contacts(q)
    path = folder / block.path
    path.parent.mkdir(parents=True, exist_ok=True)
    logging: dict[str, Any] = {}
    part = path.with_name(f"{path.stem}-{os.getpid()}{PART}")
    if keep is not None:
        # Solves are numbered from 0 in every log; with one seed all would keep the same numbers.
        own = zlib.crc32(str(block.path).encode())
        logging = {"log": part, "keep": dataclasses.replace(keep, seed=own)}
    batch = solver.solve_batch(
        points, normals, q0=study.start(block.setting), seed=study.seed, **logging
    )
    if keep is not None:
        part.replace(path.with_suffix(".mcap"))
    _frame(study, block, batch, solver.robot.fingers).write_parquet(part)
    part.replace(path)


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
