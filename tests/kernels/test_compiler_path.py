"""A compiler in a folder with a blank in its name works."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
from compilation import forget

from casadi_ik.compile import compiler


@pytest.mark.parametrize("options", ["", " -pipe"])
def test_a_path_with_a_blank_has_to_be_quoted(
    options: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler_path = shutil.which("cc") or shutil.which("gcc")
    if compiler_path is None:
        pytest.skip("needs a C compiler")
    program = tmp_path / "my tools" / "cc"
    program.parent.mkdir()
    program.symlink_to(compiler_path)
    forget(monkeypatch)
    monkeypatch.setenv("CC", f"{program}{options}")
    assert compiler.find_compiler() is None
    with pytest.warns(compiler.NoCompilerWarning) as caught:
        compiler.warn_no_compiler()
    advice = str(caught[0].message)
    # The advice of the message works.
    quoted = advice.partition('CC="')[2].partition('"')[0]
    assert str(program) in quoted
    monkeypatch.setitem(os.environ, "CC", f"{quoted}{options}")
    assert compiler.find_compiler() is not None
