"""Studies: seeded targets solved in several ways, block by block, resumable.

Needs the extra `studies`.
"""

from casadi_ik.errors import MissingExtraError

try:
    from runner.arguments import Changes, add_run_arguments, run_from
    from runner.metric import (
        Metric,
        interval_text,
        mean_metric,
        median_metric,
        rate_metric,
        write_metrics,
    )
    from runner.page import markdown_table, write_page
    from runner.program import command, program
    from runner.provenance import provenance
    from runner.results import code_of, read_results
    from runner.run import run
    from runner.study import Setting, Study, TargetSet
except ModuleNotFoundError as error:
    if error.name is None or error.name.startswith(("casadi_ik", "runner")):
        raise
    raise MissingExtraError(
        f"studies need {error.name}, which is not installed: pip install casadi-ik[studies]"
    ) from error

__all__ = [
    "Changes",
    "Metric",
    "Setting",
    "Study",
    "TargetSet",
    "add_run_arguments",
    "code_of",
    "command",
    "interval_text",
    "markdown_table",
    "mean_metric",
    "median_metric",
    "program",
    "provenance",
    "rate_metric",
    "read_results",
    "run",
    "run_from",
    "write_metrics",
    "write_page",
]
