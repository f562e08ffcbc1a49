"""State of compiled code that tests reset: loaded libraries, warnings, builds."""

from __future__ import annotations

import pytest

from casadi_ik.compile import cache, compiler, libraries


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget loaded libraries and issued warnings, as a new process would."""
    for module, name, value in (
        (libraries, "_loaded", {}),
        (cache, "_warned", set()),
        (compiler, "_warned", False),
    ):
        monkeypatch.setattr(module, name, value)


def forbid_builds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every further compilation fail."""

    def refuse(*_: object) -> None:
        raise AssertionError("compiled again")

    monkeypatch.setattr(compiler.Compiler, "build", refuse)
