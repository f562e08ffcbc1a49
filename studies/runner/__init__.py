"""Studies: seeded targets solved in several ways, part by part, resumable.

Needs the extra `dev`.
"""

import os
from importlib.util import find_spec

from casadi_ik.errors import MissingExtraError

# What is timed is compiled.
os.environ.setdefault("CASADI_IK_COMPILE", "wait")

for _name in ("joblib", "matplotlib", "polars"):
    if find_spec(_name) is None:
        raise MissingExtraError(
            f"studies need {_name}, which is not installed: pip install 'casadi-ik[dev]'"
        )
