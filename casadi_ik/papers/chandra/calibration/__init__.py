"""Calibration: dimensions of an individual hand from measured fingertip poses."""

from casadi_ik.papers.chandra.calibration.estimate import (
    LOSSES,
    Calibration,
    calibrate,
    write_description,
)
from casadi_ik.papers.chandra.calibration.measurements import (
    Measurements,
    read_measurements,
    simulate,
    true_values,
    write_measurements,
)
from casadi_ik.papers.chandra.calibration.model import (
    PARAMETER_GROUPS,
    HandModel,
    Parameter,
    Priors,
    hand_parameters,
)

__all__ = [
    "LOSSES",
    "PARAMETER_GROUPS",
    "Calibration",
    "HandModel",
    "Measurements",
    "Parameter",
    "Priors",
    "calibrate",
    "hand_parameters",
    "read_measurements",
    "simulate",
    "true_values",
    "write_description",
    "write_measurements",
]
