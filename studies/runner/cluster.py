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
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

import joblib

from casadi_ik.errors import InputError

if TYPE_CHECKING:
    from dask.distributed import Client

PATIENCE = 30
"""Seconds to wait for a scheduler to answer, and for a first worker to be there."""

STUDIES = Path(__file__).parents[1]


@contextmanager
def backend(jobs: int, dask: str | None) -> Iterator[None]:
    """Where joblib's calls go meanwhile.

    Args:
        jobs: Processes on this machine.
        dask: Address of a Dask scheduler whose workers solve instead.

    Raises:
        InputError: No scheduler answers, it has no worker, or a worker has not what is needed.
    """
    if dask is None:
        with joblib.parallel_config(backend="loky", n_jobs=jobs):
            yield
        return
    with _client(dask) as client, tempfile.TemporaryDirectory() as place:
        _check(client, dask)
        modules = Path(place) / "casadi_ik_study.zip"
        _pack(modules)
        client.upload_file(str(modules))
        with joblib.parallel_config(backend="dask"):
            yield


def _client(address: str) -> Client:
    from dask.distributed import Client

    try:
        return Client(address, timeout=PATIENCE)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"--dask {address}: found no scheduler ({error}), expected the address that "
            "`dask scheduler` prints, such as tcp://HOST:8786"
        ) from error


def _check(client: Client, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except TimeoutError as error:
        raise InputError(
            f"--dask {address}: found no worker within {PATIENCE} s, expected at least one: "
            f"`dask worker {address}`"
        ) from error
    import cloudpickle

    mine, here = installed(), sys.modules[__name__]
    # The question has to travel whole: this module is not there yet.
    cloudpickle.register_pickle_by_value(here)
    try:
        found, scheduler = client.run(installed), client.run_on_scheduler(installed)
    finally:
        cloudpickle.unregister_pickle_by_value(here)
    assert isinstance(found, dict)
    for place, theirs in {**found, "the scheduler": scheduler}.items():
        if theirs != mine:
            raise InputError(
                f"--dask {address}: {place} has {_listed(theirs)}, expected {_listed(mine)} as here"
            )


def installed() -> dict[str, str]:
    """Versions that a study's results depend on, or without which it does not run."""
    found = {"python": f"{sys.version_info[0]}.{sys.version_info[1]}"}
    for name in ("casadi-ik", "casadi", "numpy", "polars", "joblib"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "none"
    return found


def _listed(packages: dict[str, str]) -> str:
    return ", ".join(f"{name} {text}" for name, text in packages.items())


def _pack(path: Path) -> None:
    """A zip of the studies' modules in use here; the script itself travels with its calls."""
    files = [getattr(module, "__file__", None) for module in list(sys.modules.values())]
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted({Path(name).resolve() for name in files if name}):
            if file.is_relative_to(STUDIES) and str(file) != getattr(
                sys.modules["__main__"], "__file__", ""
            ):
                archive.write(file, file.relative_to(STUDIES))
