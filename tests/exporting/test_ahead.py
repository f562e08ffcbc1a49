"""What is compiled ahead is all that is needed later."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

import casadi_ik as ik
from casadi_ik.exporting.ahead import uses
from casadi_ik.kernels import libraries
from casadi_ik.kernels.compiler import Compiler, find_compiler


@pytest.mark.skipif(find_compiler() is None, reason="needs a C compiler")
def test_nothing_is_compiled_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CASADI_IK_CACHE", str(tmp_path))

    def through_all_uses() -> list[str]:
        monkeypatch.setattr(libraries, "_loaded", {})
        done = []
        for what, use in uses(ik.load_robot("ar10"), everything=True):
            use()
            done.append(what)
        return done

    done = through_all_uses()
    assert {"one target", "batches", "scenes", "choices", "ways to a grasp", "followers"} <= {*done}

    def refuse(*_: object) -> None:
        raise AssertionError("compiled again")

    monkeypatch.setattr(Compiler, "build", refuse)
    monkeypatch.setattr(subprocess, "Popen", refuse)
    assert through_all_uses() == done
