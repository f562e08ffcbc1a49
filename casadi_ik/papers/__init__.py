"""The methods of the two papers, and the reference they are compared with.

`qiu/` is Qiu & Kermani 2021 (`enhanced-*`, `original-*`), `screw_control` and `screw_tasks` are
Chandra et al. 2019 (`ScrewControl`), `ipopt` solves the whole arm-hand as one nonlinear program.
"""

from casadi_ik.papers.screw_control import ScrewControl, Trajectory
from casadi_ik.papers.screw_tasks import ScrewTask

__all__ = ["ScrewControl", "ScrewTask", "Trajectory"]
