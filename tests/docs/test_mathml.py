"""Formulas of the site are valid MathML with indices beside their letters."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))

from building.mathml import mathml


def flat(tex: str) -> str:
    return "".join(mathml(tex, display=True).split())


def test_index_is_placed_beside_an_accented_letter() -> None:
    rendered = flat(r"\dot q_t")
    assert "<msub><moveraccent" in rendered
    assert "munderover" not in rendered
