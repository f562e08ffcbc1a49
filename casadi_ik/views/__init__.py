"""Pictures of grasps and of convergence; needs matplotlib, the extra `plots`."""

from casadi_ik.errors import MissingExtraError

try:
    import matplotlib as _  # noqa: F401
except ImportError as error:
    raise MissingExtraError(
        "pictures need matplotlib, which is not installed: pip install casadi-ik[plots]"
    ) from error

from casadi_ik.views.convergence import draw_convergence
from casadi_ik.views.scene import draw_solution

__all__ = ["draw_convergence", "draw_solution"]
