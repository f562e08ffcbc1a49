"""The compiled drivers of grasp generation."""

from __future__ import annotations

from typing import Any

from casadi_ik.compile.codegen import WIDE, define, driver_text
from casadi_ik.compile.function_kernel import machine_lanes
from casadi_ik.compile.libraries import load_library
from casadi_ik.errors import UnsupportedError


def touch_library() -> Any:
    """Return the compiled drivers `touch`, `apart`, `loads` and `nearest`.

    Raises:
        UnsupportedError: There is no C compiler.
    """
    sources = (
        WIDE if machine_lanes() else "",
        "typedef double scalar;\ntypedef double real;\n",
        define({"STEP_IN": 0, "STEP_OUT": 0}),
        *(driver_text(name) for name in ("common", "touch_job", "touch", "loads", "nearest")),
    )
    text = "".join(sources)
    library = load_library("touch", lambda: text, "casadi_ik_touch", text)
    if library is None:
        raise UnsupportedError(
            "grasps_of: a C compiler is missing; expected one on the path (docs/install.md)"
        )
    return library
