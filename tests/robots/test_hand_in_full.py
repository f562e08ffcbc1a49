"""An arm-hand file whose hand stands in it in full, instead of by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import casadi_ik as ik

MODELS = Path(__file__).parents[2] / "models"


def in_full(folder: Path, name: str = "kuka_lwr_barrett", **changes: Any) -> Path:
    """A shipped robot with its hand written out; keyword arguments replace the hand's keys."""
    models = MODELS
    robot = yaml.safe_load((models / "arm_hands" / f"{name}.yaml").read_text())
    hand = yaml.safe_load((models / "hands" / f"{robot['hand']}.yaml").read_text())
    path = folder / "whole.yaml"
    path.write_text(yaml.safe_dump(robot | {"hand": hand | changes}, sort_keys=False))
    return path


@pytest.mark.parametrize("name", ["kuka_lwr_barrett", "ar10"])
def test_it_is_the_same_robot(name, tmp_path, rng):
    whole, named = ik.load_robot(in_full(tmp_path, name)), ik.load_robot(name)
    assert whole.actuators == named.actuators
    q = named.random(rng, 5)
    for ours, theirs in zip(whole.contacts(q), named.contacts(q), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"palm": {"link": "nowhere", "source": "jhu"}}, "palm.link: unknown link 'nowhere'"),
        ({"joints": [1]}, r"hand\.joints\[0\]: expected `object`, got `int`"),
        ({"colour": "red"}, "hand: object contains unknown field `colour`"),
    ],
)
def test_its_errors_name_the_file_and_the_key(changes, words, tmp_path):
    path = in_full(tmp_path, **changes)
    with pytest.raises(ik.errors.DescriptionError, match=words) as caught:
        ik.load_robot(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_neither_a_name_nor_a_hand(tmp_path):
    path = tmp_path / "whole.yaml"
    path.write_text("name: a\nhand: 3\nthumb: b\nfingers: [b]\n")
    with pytest.raises(
        ik.errors.DescriptionError, match=r"hand: expected `str \| object`, got `int`"
    ):
        ik.load_robot(path)
