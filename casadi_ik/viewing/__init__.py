"""Pages in the browser in which contacts are dragged and logs play; needs the extra `view`."""

from casadi_ik.errors import MissingExtraError

try:
    import viser as _  # noqa: F401
except ImportError as error:
    raise MissingExtraError(
        f"views in the browser need {error.name}, which is not installed: "
        "pip install casadi-ik[view]"
    ) from error

from casadi_ik.viewing.server import HOST, PORT, Viewer
from casadi_ik.viewing.start import view_grasp, view_log, view_pads

__all__ = ["HOST", "PORT", "Viewer", "view_grasp", "view_log", "view_pads"]
