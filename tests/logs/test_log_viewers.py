"""The log read by the npm packages that Foxglove and Lichtblick are made of."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up_solves import make_block

import casadi_ik as ik

PACKAGES = (
    "@mcap/core@2.2.2",
    "@foxglove/rosmsg@5.0.5",
    "@foxglove/rosmsg2-serialization@3.1.0",
    "fzstd@0.1.1",
)


@pytest.fixture(scope="module")
def packages() -> Path:
    """A folder with the packages, made once per machine; without node or registry, no test."""
    npm = shutil.which("npm")
    if npm is None or shutil.which("node") is None:
        pytest.skip("needs node and npm")
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    folder = cache / "casadi_ik_tests" / "-".join(name.rpartition("@")[2] for name in PACKAGES)
    if not (folder / "complete").exists():
        folder.mkdir(parents=True, exist_ok=True)
        command = [npm, "install", "--no-audit", "--no-fund", "--prefix", folder, *PACKAGES]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=120)
        except (subprocess.CalledProcessError, subprocess.TimeoutExpired) as error:
            pytest.skip(f"npm cannot install: {error}")
        (folder / "complete").touch()
    return folder


def numbers(value: Any) -> np.ndarray:
    """Numbers as the script prints them."""
    names = {"NaN": np.nan, "Infinity": np.inf, "-Infinity": -np.inf}
    items = value if isinstance(value, list) else [value]
    return np.array([names[x] if isinstance(x, str) else x for x in items], dtype=float)


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_mcap_core_and_rosmsg2_serialization(
    packages: Path, tmp_path: Path, write: Callable[..., Path], compression: str
) -> None:
    path = write(make_block(40, 7), urdf="<robot/>", compression=compression)
    script = Path(__file__).parent / "read_log.mjs"
    done = subprocess.run(
        ["node", script, packages, path], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    messages = [json.loads(line) for line in done.stdout.splitlines()]
    log = ik.logs.open(path)
    for kind, table in (
        ("iteration", log.iterations()),
        ("solve", log.solves()),
        ("event", log.events()),
    ):
        found = [m for m in messages if m["topic"] == f"/ik/enhanced-dls/{kind}"]
        assert len(found) == len(table) > 0
        for message, row in zip(found, table.rows, strict=True):
            for name in table.names:
                np.testing.assert_array_equal(numbers(message["values"][name]), row[name].ravel())
    times = [int(message["time"]) for message in messages]
    assert times == sorted(times)
