"""A small slice of the study of collisions."""

from __future__ import annotations

import collision
from collision_study import search


def test_a_check_is_never_free_where_others_see_a_penetration():
    rows, sentence = collision.check(60, 32, 0)
    assert [row[0] for row in rows] == ["random", "free"]
    assert "1 um: **0**" in sentence
    part = collision.Part("coal", search.Piece(collision.ROBOT, 0, 0, 0, 0), 60)
    found = collision.solve(part)
    assert found["checked"] == 60
    assert 0 < found["free"] < 60
    assert found["others"] == 1
    assert found["falsely_free"] == 0
