"""Pictures in files are independent of the backend of matplotlib in the environment."""

from pathlib import Path

import pytest
from processes import python

import casadi_ik as ik


@pytest.mark.parametrize("backend", ["not_installed", "module://not_installed", "agg", ""])
def test_an_inherited_backend(backend: str, tmp_path: Path, log: ik.logs.Log) -> None:
    picture = tmp_path / "cup.png"
    words = "-m", "casadi_ik", "log", "plot", log.shards[0].path, "--out", picture
    done = python(*words, env={"MPLBACKEND": backend})
    assert (done.returncode, done.stderr) == (0, "")
    assert picture.read_bytes().startswith(b"\x89PNG")
