"""Where blocks are solved: processes of this machine, or a Dask cluster.

A cluster needs the installed package with its extra `studies` and nothing else: the study's own
modules are sent to it, and what its workers solve comes back as bytes.
"""

from __future__ import annotations

import sys
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from casadi_ik.batches import backend as places

STUDIES = Path(__file__).parents[1]
PACKAGES = (*places.PACKAGES, "polars")


@contextmanager
def backend(jobs: int, dask: str | None) -> Iterator[None]:
    """Where joblib's calls go meanwhile, see `casadi_ik.batches.backend`.

    Args:
        jobs: Processes on this machine.
        dask: Address of a Dask scheduler whose workers solve instead.

    Raises:
        InputError: No scheduler answers, it has no worker, or a worker has not what is needed.
    """
    with places.backend(jobs, dask, PACKAGES) as client, tempfile.TemporaryDirectory() as place:
        if client is not None:
            modules = Path(place) / "casadi_ik_study.zip"
            _pack(modules)
            client.upload_file(str(modules))
        yield


def _pack(path: Path) -> None:
    """A zip of the studies' modules in use here; the script itself travels with its calls."""
    files = [getattr(module, "__file__", None) for module in list(sys.modules.values())]
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted({Path(name).resolve() for name in files if name}):
            if file.is_relative_to(STUDIES) and str(file) != getattr(
                sys.modules["__main__"], "__file__", ""
            ):
                archive.write(file, file.relative_to(STUDIES))
