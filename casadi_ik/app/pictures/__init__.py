"""Pictures of grasps, motions and convergence; needs the extra `plots` (matplotlib, PyVista)."""

import warnings

from casadi_ik.app.pictures.backend import import_matplotlib
from casadi_ik.errors import optional_import

with optional_import("pictures"):
    import_matplotlib()
    with warnings.catch_warnings():
        # PyVista's download library warns in notebooks without widgets.
        warnings.filterwarnings("ignore", "IProgress not found")
        import pyvista as _pyvista  # noqa: F401

from casadi_ik.app.pictures.charts import draw_convergence
from casadi_ik.app.pictures.grasps import draw_alternatives, draw_grasps
from casadi_ik.app.pictures.pictures import draw_motion, draw_pads, draw_solution, show
from casadi_ik.app.pictures.reach import draw_base_placement, draw_reach_map
from casadi_ik.app.pictures.study_report import study_page

__all__ = [
    "draw_alternatives",
    "draw_base_placement",
    "draw_convergence",
    "draw_grasps",
    "draw_motion",
    "draw_pads",
    "draw_reach_map",
    "draw_solution",
    "show",
    "study_page",
]
