"""Solves the parts of a batch that are missing."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from casadi_ik.api import Solver
from casadi_ik.arrays import Array
from casadi_ik.batches.backend import backend
from casadi_ik.batches.folder import BatchFolder
from casadi_ik.batches.part import Asked, SolvedPart, solve_part
from casadi_ik.batches.sources import Source
from casadi_ik.errors import CasadiIKError, InputError
from casadi_ik.grasps.pose import moved

ONE: Any = 1
"""Calls sent together; joblib's annotation knows the word "auto" only."""


def solve_parts(
    solver: Solver,
    source: Source,
    asked: Asked,
    folder: BatchFolder,
    jobs: int = 1,
    dask: str | None = None,
    object_pose: Array | None = None,
) -> Iterator[SolvedPart]:
    """Solve what is missing and put it into its place; in the order in which parts are finished.

    Args:
        solver: The solver; it travels to the workers.
        source: The targets.
        asked: What is asked of all parts alike.
        folder: Where parts are and go; claimed already.
        jobs: Processes on this machine.
        dask: Address of a Dask scheduler whose workers solve instead. A worker that dies costs
            what it was solving, which others do again.
        object_pose: (4, 4) where the object is in whose frame the targets are; None: they are in
            the base frame.

    Yields:
        The parts, stored.

    Raises:
        InputError: A file of targets is damaged, or the cluster cannot be used or went away; what
            is finished by then is in the folder.
        OSError: A part cannot be stored.
    """
    done = folder.done()
    if len(done.intersection(range(len(source.sizes)))) == len(source.sizes):
        return
    pickled = pickle.dumps(solver)
    with backend(jobs, dask):
        import joblib

        # A batch of calls would come back, and be lost, as a whole.
        parallel = joblib.Parallel(return_as="generator_unordered", batch_size=ONE)
        parts = source.without(done)
        if object_pose is not None:
            parts = (replace(part, arrays=moved(part.arrays, object_pose)) for part in parts)
        calls = (joblib.delayed(solve_part)(pickled, asked, part) for part in parts)
        solved = iter(parallel(calls))
        while True:
            try:
                ended = next(solved)
            except StopIteration:
                return
            except CasadiIKError:
                raise
            except Exception as error:
                if dask is None:
                    raise
                raise InputError(
                    f"--dask {dask}: the cluster went away ({type(error).__name__}: {error}); "
                    f"{folder.path} has {len(folder.done())} of {len(source.sizes)} parts, "
                    "--resume goes on with them"
                ) from error
            assert isinstance(ended, SolvedPart)
            folder.store(ended)
            yield ended
