"""Check the language of names and docstrings: rules 2 and 3 of CONTRIBUTING.md.

    python tools/check_language.py [--list] [FOLDER ...]

A vague name is a participle, a pronoun or an adverb that does not say what the thing is (`found`,
`one`, `here`). A vague summary is a docstring that starts like a relative clause ("What is ...").
The command fails if a folder has more of them than `LIMITS` permits. Lower a limit when you have
corrected names; never raise one.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]

LIMITS = {"casadi_ik": 46, "docs": 1, "page": 0, "studies": 10, "tests": 8, "tools": 4}
"""Maximum number of vague names and summaries by folder."""

VAGUE_NAMES = frozenset(
    re.findall(
        r"\w+",
        """
    about again alone along another apart aside asked away before beyond brought called carried
    chosen drawn each eased every far followed found given gone had half hardly held here how inside
    joined judged kept known last_of least less like looked lost made many meant met mine more most
    moved near nearly no nobody nothing now often once one ones other others over own parted passed
    picked promised put rather reached rest room said same saw seen several shown so some someone
    somewhere spent stood such swung taken that their there these thing things this those thought
    together told touched tried turned used wanted way ways what when where whether which while
    whole why with without worth
        """,
    )
)

VAGUE_SUMMARY = re.compile(
    r"(what|whether|where|how|which|who|why|when|of|those|these|some|ones?|the ones?|as|about|so|"
    r"like|another|others?|such|nothing|anything|something|everything|it|they|them|its|their)\b",
    re.IGNORECASE,
)


def findings(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line and text of every vague name and summary of a file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        for name in _defined_names(node):
            if name.strip("_").lower() in VAGUE_NAMES:
                yield getattr(node, "lineno", 1), f"vague name `{name}`"
        if isinstance(node, (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            summary = (ast.get_docstring(node) or "").partition("\n")[0]
            if VAGUE_SUMMARY.match(summary):
                yield node.lineno, f"vague summary {summary!r}"


def _defined_names(node: ast.AST) -> list[str]:
    """Return the names that a node assigns or defines."""
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
        args = node.args
        named = [*args.posonlyargs, *args.args, *args.kwonlyargs, args.vararg, args.kwarg]
        names = [arg.arg for arg in named if arg is not None]
        return names if isinstance(node, ast.Lambda) else [node.name, *names]
    if isinstance(node, ast.ClassDef):
        return [node.name]
    if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
        return [node.id]
    if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
        return [node.attr]
    return []


def main(arguments: list[str] | None = None) -> int:
    """Check the folders; return 1 if one exceeds its limit."""
    parser = argparse.ArgumentParser(description="Check the language of names and docstrings.")
    parser.add_argument("folders", nargs="*", default=list(LIMITS))
    parser.add_argument("--list", action="store_true", help="list every finding")
    options = parser.parse_args(arguments)
    failed = False
    for folder in options.folders:
        lines = [
            f"{path.relative_to(ROOT)}:{line}: {text}"
            for path in sorted((ROOT / folder).rglob("*.py"))
            if "node_modules" not in path.parts
            for line, text in findings(path)
        ]
        exceeded = len(lines) > LIMITS[folder]
        failed |= exceeded
        if options.list or exceeded:
            print("\n".join(lines))
        print(f"{folder}: {len(lines)} vague names and summaries, limit {LIMITS[folder]}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
