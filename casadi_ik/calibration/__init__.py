"""Calibration: the hand's own dimensions from measured fingertip poses."""

from casadi_ik.calibration.describe import write_description
from casadi_ik.calibration.estimate import calibrate
from casadi_ik.calibration.losses import LOSSES
from casadi_ik.calibration.measurements import (
    Measurements,
    read_measurements,
    write_measurements,
)
from casadi_ik.calibration.model import HandModel
from casadi_ik.calibration.parameters import GROUPS, Parameter, Priors, hand_parameters
from casadi_ik.calibration.result import Calibration
from casadi_ik.calibration.synthetic import simulate, true_values

__all__ = [
    "GROUPS",
    "LOSSES",
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
