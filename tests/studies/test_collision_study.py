"""A small slice of the study of collisions."""

from __future__ import annotations

import collision
import pytest


def test_a_check_is_never_free_where_others_see_a_penetration():
    rows, sentences = collision.check(60, 32, 0)
    assert [row[0] for row in rows] == ["random", "free"]
    assert "60 random configurations" in sentences[0]
    for sentence in sentences:
        assert "1 um: **0**" in sentence


def test_the_choice_is_measured(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(collision, "CLUTTER", (3,))
    (row,) = collision.choice(1, 64, 0)
    clutter, targets, _, found, _, false_free, *_ = row
    assert (clutter, targets, false_free) == ("3", "1", "0")
    assert found in ("0 of 0", "1 of 1")
