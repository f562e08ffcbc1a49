"""The paper's parameters: its numbers, and what else is refused."""

from __future__ import annotations

import dataclasses

import pytest

from casadi_ik.errors import InputError
from casadi_ik.papers.qiu.parameters import QiuParameters


def test_defaults_are_the_papers():
    options = QiuParameters()
    assert options.reaching_damping == 1.0
    assert options.chain_damping == 150.0
    assert (options.virtual_weight, options.joint_weight) == (10.0, 1.0)
    assert options.max_iterations == 10_000
    assert options.finger_step == "ipopt"
    assert options.borrowed == 1


def test_every_field_is_explained():
    text = QiuParameters.__doc__ or ""
    for entry in dataclasses.fields(QiuParameters):
        assert f"{entry.name}:" in text


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"finger_step": "fmincon"}, "finger_step: found 'fmincon', expected one of ipopt, closed"),
        ({"palm_error": 3}, "palm_error: found 3, expected one of euler"),
        ({"platform": "hand"}, "platform: found 'hand', expected one of arm-leg, palm"),
        ({"chain_damping": 0.0}, "chain_damping: found 0.0, expected a number > 0"),
        ({"chain_damping": float("nan")}, "chain_damping: found nan"),
        ({"reaching_damping": "much"}, "reaching_damping: found 'much', expected a number > 0"),
        ({"virtual_weight": -1}, "virtual_weight: found -1"),
        ({"max_iterations": 0}, "max_iterations: found 0, expected an integer > 0"),
        ({"max_iterations": 10.5}, "max_iterations: found 10.5, expected an integer"),
        ({"borrowed": -1}, "borrowed: found -1, expected an integer >= 0"),
        ({"borrowed": True}, "borrowed: found True"),
        ({"step_cap": 0.0}, "step_cap: found 0.0"),
    ],
)
def test_impossible_values(options, says):
    with pytest.raises(InputError) as caught:
        QiuParameters(**options)
    assert says in str(caught.value)


def test_zero_where_it_means_something():
    assert QiuParameters(borrowed=0).borrowed == 0
