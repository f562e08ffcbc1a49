"""One block solved and written: what a worker does."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

import casadi_ik as ik
from runner.study import Block, Study, robot_of

PART = ".part"
"""Ending of a file that is not complete."""


def solve_block(study: Study, block: Block, folder: Path, keep: Any = None) -> None:
    """Solve a block and write its results, with its log if asked for.

    Results appear under their name when they are complete, and after the log: a block that is
    there is there with everything.

    Args:
        study: The study.
        block: The block.
        folder: The study's folder.
        keep: What to log (`casadi_ik.logs.Keep`); None: no log.
    """
    solver = study.solver(block.setting)
    q = study.configurations(block.targets, block.number)
    points, normals = robot_of(study.robot).contacts(q)
    path = folder / block.path
    path.parent.mkdir(parents=True, exist_ok=True)
    logging: dict[str, Any] = {}
    part, log = path.with_name(f"{path.stem}-{os.getpid()}{PART}"), path.with_suffix(".mcap")
    if keep is not None:
        logging = {"log": log, "keep": keep}
    batch = solver.solve_batch(
        points, normals, q0=study.start(block.setting), seed=study.seed, **logging
    )
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
