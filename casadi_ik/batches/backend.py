"""Where parts are solved: processes of this machine, or a Dask cluster, both through joblib.

The workers of a cluster need the installed package and its extra `cluster`, and no folder in
common with who asks.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING

from casadi_ik.errors import InputError, UnsupportedError

if TYPE_CHECKING:
    from dask.distributed import Client

PATIENCE = 30
"""Seconds to wait for a scheduler to answer, and for a first worker to be there."""

PACKAGES = ("casadi-ik", "casadi", "numpy", "joblib")
"""What answers depend on, or what is needed to come to any."""


@contextmanager
def backend(
    jobs: int, dask: str | None, packages: tuple[str, ...] = PACKAGES
) -> Iterator[Client | None]:
    """Where joblib's calls go meanwhile.

    Args:
        jobs: Processes on this machine.
        dask: Address of a Dask scheduler whose workers solve instead.
        packages: Which packages they have to have in the versions that are here.

    Yields:
        The client of the cluster; None: it is this machine.

    Raises:
        InputError: No scheduler answers, it has no worker, or a worker has not what is needed.
        UnsupportedError: joblib or Dask is not installed here.
    """
    check_installed(dask)
    import joblib
    from joblib.externals.loky import get_reusable_executor

    if dask is None:
        with joblib.parallel_config(backend="loky", n_jobs=jobs):
            try:
                yield None
            except (KeyboardInterrupt, GeneratorExit):
                # By themselves they would finish what they have and wait for more.
                get_reusable_executor().shutdown(wait=False, kill_workers=True)
                raise
        return
    with _quiet(), _client(dask) as client:
        _check(client, dask, packages)
        with joblib.parallel_config(backend="dask"):
            yield client


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask from printing tracebacks of lost connections; what matters is raised."""
    # They have levels of their own, so that it does not help to set one above them.
    loggers = [
        logging.getLogger(name)
        for name in list(logging.root.manager.loggerDict)
        if name.partition(".")[0] in ("asyncio", "distributed", "tornado")
    ]
    before = [logger.disabled for logger in loggers]
    for logger in loggers:
        logger.disabled = True
    try:
        yield
    finally:
        for logger, disabled in zip(loggers, before, strict=True):
            logger.disabled = disabled


def check_installed(cluster: str | None) -> None:
    """See to it that there is what parts need.

    Args:
        cluster: Address of a Dask scheduler; None: this machine.

    Raises:
        UnsupportedError: joblib or Dask is not installed here.
    """
    try:
        import joblib  # noqa: F401
    except ImportError as error:
        raise UnsupportedError(
            "batches in parts (--resume, --part-size, --dask, Parquet, folders) need joblib: "
            "pip install 'casadi-ik[cluster]'"
        ) from error
    if cluster is None:
        return
    try:
        import dask.distributed  # noqa: F401 - makes its loggers
    except ImportError as error:
        raise UnsupportedError("--dask: needs Dask: pip install 'casadi-ik[cluster]'") from error


def _client(address: str) -> Client:
    from dask.distributed import Client

    try:
        return Client(address, timeout=PATIENCE)
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"--dask {address}: found no scheduler ({error}), expected the address that "
            "`dask scheduler` prints, such as tcp://HOST:8786"
        ) from error


def _check(client: Client, address: str, packages: tuple[str, ...]) -> None:
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except TimeoutError as error:
        raise InputError(
            f"--dask {address}: found no worker within {PATIENCE} s, expected at least one: "
            f"`dask worker {address}`"
        ) from error
    import cloudpickle

    mine, here = installed(packages), sys.modules[__name__]
    # The question has to travel whole: this package may be another there, or none.
    cloudpickle.register_pickle_by_value(here)
    try:
        found = client.run(installed, packages)
        scheduler = client.run_on_scheduler(installed, packages)
    finally:
        cloudpickle.unregister_pickle_by_value(here)
    assert isinstance(found, dict)
    for place, theirs in {**found, "the scheduler": scheduler}.items():
        if theirs != mine:
            raise InputError(
                f"--dask {address}: {place} has {_listed(theirs)}, expected {_listed(mine)} as here"
            )


def installed(packages: tuple[str, ...]) -> dict[str, str]:
    """Python and versions of packages; "none" of what is not there."""
    found = {"python": f"{sys.version_info[0]}.{sys.version_info[1]}"}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "none"
    return found


def _listed(packages: dict[str, str]) -> str:
    return ", ".join(f"{name} {text}" for name, text in packages.items())
