"""What the robot is: frozen data from YAML, numpy only."""

from casadi_ik.robots.couplings import Coupling, FourBar, LeadScrew, Linear, Polynomial
from casadi_ik.robots.description import Actuator, Finger, Joint, RobotDescription
from casadi_ik.robots.load import load_description
from casadi_ik.robots.urdf import to_urdf

__all__ = [
    "Actuator",
    "Coupling",
    "Finger",
    "FourBar",
    "Joint",
    "LeadScrew",
    "Linear",
    "Polynomial",
    "RobotDescription",
    "load_description",
    "to_urdf",
]
