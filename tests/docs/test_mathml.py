"""Formulas of the site: indices beside their letters, functions apart from what they are of."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))

from building.mathml import mathml


def flat(tex: str) -> str:
    return "".join(mathml(tex, display=True).split())


def test_index_is_placed_beside_an_accented_letter() -> None:
    rendered = flat(r"\dot q_t")
    assert "<msub><moveraccent" in rendered
    assert "munderover" not in rendered


def test_norm_bars_have_letter_height() -> None:
    assert flat(r"\lVert x_i\rVert").count('stretchy="false">‖') == 2


@pytest.mark.parametrize(("tex", "spaces"), [(r"a\cos x", 2), (r"\cos x", 1), (r"\cos(x)", 0)])
def test_functions_are_spaced(tex: str, spaces: int) -> None:
    assert flat(tex).count("0.17em") == spaces
