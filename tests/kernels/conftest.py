"""Every kernel test builds into a cache of its own session."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def session_cache(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(tmp_path_factory.mktemp("kernel_cache"))


@pytest.fixture(autouse=True)
def own_cache(session_cache: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests share one cache, apart from the user's and from tests of the cache itself."""
    monkeypatch.setenv("CASADI_IK_CACHE", session_cache)
    monkeypatch.delenv("CASADI_IK_CFLAGS", raising=False)
