"""The methods of the two papers, and the reference they are compared with.

`qiu/` is Qiu & Kermani 2021 (`enhanced-*`, `original-*`), `chandra/` is Chandra et al. 2019
(`ScrewControl`, calibration), `ipopt` solves the whole arm-hand as one nonlinear program.
Importing this package adds its methods to the registry.
"""

from casadi_ik.papers.chandra.screw_control import ScrewControl, Trajectory
from casadi_ik.papers.chandra.screw_tasks import ScrewTask
from casadi_ik.papers.ipopt import IpoptMethod, IpoptParameters
from casadi_ik.papers.qiu.method import EnhancedMethod, OriginalMethod
from casadi_ik.papers.qiu.step import OriginalParameters, QiuParameters
from casadi_ik.solve.registry import add_shipped_method

__all__ = ["ScrewControl", "ScrewTask", "Trajectory"]

_PAPER = "(Qiu & Kermani 2021)"

add_shipped_method(
    "enhanced-dls",
    f"thumb first, then the arm-thumb closed chain; damped least squares {_PAPER}",
    QiuParameters,
    EnhancedMethod,
    {"steps": "dls"},
)
add_shipped_method(
    "enhanced-sdls",
    f"enhanced-dls with selectively damped least squares {_PAPER}",
    QiuParameters,
    EnhancedMethod,
    {"steps": "sdls"},
)
add_shipped_method(
    "original-dls",
    f"all contacts in one hierarchy, the baseline of the paper; damped least squares {_PAPER}",
    OriginalParameters,
    OriginalMethod,
    {"steps": "dls"},
)
add_shipped_method(
    "original-sdls",
    f"original-dls with selectively damped least squares {_PAPER}",
    OriginalParameters,
    OriginalMethod,
    {"steps": "sdls"},
)
add_shipped_method(
    "ipopt",
    "the whole arm-hand as one nonlinear program, with restarts: a slow reference",
    IpoptParameters,
    IpoptMethod,
)
