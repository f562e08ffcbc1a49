"""Every kernel test builds into a cache of its session."""

from __future__ import annotations

from pathlib import Path

import pytest
from compilation import forget


@pytest.fixture(scope="session")
def session_cache(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(tmp_path_factory.mktemp("kernel_cache"))


@pytest.fixture(autouse=True)
def own_cache(session_cache: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Use one cache for the tests, apart from that of the user."""
    monkeypatch.setenv("CASADI_IK_CACHE", session_cache)
    monkeypatch.delenv("CASADI_IK_CFLAGS", raising=False)


@pytest.fixture
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Path of an empty cache, in a process without loaded libraries and issued warnings."""
    place = tmp_path / "cache"
    monkeypatch.setenv("CASADI_IK_CACHE", str(place))
    forget(monkeypatch)
    return place
