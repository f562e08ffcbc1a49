"""Deprecated names of logs."""

from __future__ import annotations

import pytest

from casadi_ik import logs


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("Asked", "LoggedTarget"),
        ("OneSolve", "SolveRecord"),
        ("matched", "match_targets"),
        ("side_by_side", "compare_solves"),
    ],
)
def test_deprecated_names_warn(old: str, new: str) -> None:
    with pytest.warns(DeprecationWarning, match=new):
        assert getattr(logs, old) is getattr(logs, new)
