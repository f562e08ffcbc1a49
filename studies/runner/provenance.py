"""Where figures come from: machine, versions, code."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from pathlib import Path

from casadi_ik.kernels.compiler import find_compiler
from casadi_ik.logs.provenance import machine, package_versions

PACKAGES = ("casadi-ik", "casadi", "numpy", "polars", "joblib", "dask")


def provenance(code: Mapping[str, str | None]) -> str:
    """A paragraph of Markdown.

    Args:
        code: Version of the code the results of every study were made with (`code_of`).
    """
    on = machine()
    compiler = find_compiler()
    versions = ", ".join(f"{name} {text}" for name, text in package_versions(PACKAGES).items())
    made = {name: text for name, text in code.items() if text is not None}
    sources = ", ".join(f"{name} `{text}`" for name, text in made.items())
    return (
        f"Machine: {on['processor']}, {on['cores']} cores, {on['system']}; "
        f"{compiler.version if compiler else 'no C compiler'}. Packages: {versions}. Sources "
        f"(version and digest): {sources}; report written at commit `{_commit()}`."
    )


def _commit() -> str:
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short=12", "HEAD"]
    try:
        done = subprocess.run(command, capture_output=True, text=True)
    except OSError:
        return "unknown"
    return done.stdout.strip() or "unknown"
