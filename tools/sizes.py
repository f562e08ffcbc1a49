"""What the code weighs: lines, files, modules with one importer, numeric constants, by folder.

`python tools/sizes.py` prints a Markdown report; `--against CHECKOUT` puts another checkout's
numbers beside. A line of code is one that holds anything but a comment, a docstring or blanks.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import tokenize
from collections import Counter, defaultdict
from pathlib import Path

PACKAGE = "casadi_ik"
BLANK = frozenset(
    (
        *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE),
        *(tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER),
    )
)
HAND_FIRST = ("methods/hand_first", "methods/common")
"""Folders of the default method and of what it works with."""


def code_lines(text: str) -> int:
    """Lines that hold code."""
    used: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in BLANK:
            used.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.Expr) or not isinstance(node.value, ast.Constant):
            continue
        if isinstance(node.value.value, str):
            used.difference_update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(used)


def c_lines(text: str) -> int:
    """Lines of C that hold code."""
    text = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
    return sum(bool(line.split("//")[0].strip()) for line in text.splitlines())


def python(folder: Path) -> list[Path]:
    """Python files below a folder."""
    return sorted(path for path in folder.rglob("*.py") if ".venv" not in path.parts)


def module(path: Path, root: Path) -> str:
    """The dotted name of a file of the package."""
    return ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")


def single_importers(root: Path) -> int:
    """Modules that exactly one other module of the package imports."""
    files = python(root / PACKAGE)
    importers: dict[str, set[str]] = defaultdict(set)
    for path in files:
        name = module(path, root)
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(PACKAGE):
                for imported in (node.module, *(f"{node.module}.{a.name}" for a in node.names)):
                    importers[str(imported)].add(name)
            elif isinstance(node, ast.Import):
                for alias in node.names:
                    importers[alias.name].add(name)
    names = [module(path, root) for path in files if path.name != "__init__.py"]
    return sum(len(importers[name] - {name}) == 1 for name in names)


def numbers(tree: ast.Module) -> int:
    """Module constants that are a number."""
    found = 0
    for node in tree.body:
        if isinstance(node, ast.Assign):
            named = all(isinstance(t, ast.Name) and t.id.isupper() for t in node.targets)
            try:
                found += named and isinstance(ast.literal_eval(node.value), (int, float))
            except (ValueError, TypeError):
                continue
    return found


def sizes(root: Path) -> dict[str, int]:
    """Every figure of the report, by what it counts."""
    package, tests = python(root / PACKAGE), python(root / "tests")
    texts = {path: path.read_text() for path in package}
    internal = re.compile(rf"^\s*(from|import) {PACKAGE}\.", re.MULTILINE)
    asserting = [path for path in tests if path.name.startswith("test_")]
    c_files = [path for end in ("*.c", "*.h", "*.hpp") for path in (root / PACKAGE).rglob(end)]
    flagship = [path for path in (*package, *c_files) if _below(path, root, HAND_FIRST)]
    found = {
        "package, files": len(package),
        "package, lines of code": sum(map(code_lines, texts.values())),
        "package, lines of C": sum(c_lines(path.read_text()) for path in c_files),
        "hand-first and what it works with, Python and C": sum(
            (code_lines if path.suffix == ".py" else c_lines)(path.read_text()) for path in flagship
        ),
        "modules with one importer": single_importers(root),
        "numeric constants of modules": sum(numbers(ast.parse(text)) for text in texts.values()),
        "studies, lines of code": sum(code_lines(p.read_text()) for p in python(root / "studies")),
        "tests, lines": sum(path.read_text().count("\n") for path in tests),
        "tests, files": len(asserting),
        "tests that import internals": sum(bool(internal.search(p.read_text())) for p in asserting),
    }
    folders: Counter[str] = Counter()
    for path, text in texts.items():
        folders[path.relative_to(root / PACKAGE).parts[0]] += code_lines(text)
    return found | {f"{PACKAGE}/{name}": count for name, count in folders.most_common()}


def _below(path: Path, root: Path, folders: tuple[str, ...]) -> bool:
    return any(path.is_relative_to(root / PACKAGE / folder) for folder in folders)


def main() -> None:
    """Print the report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("root", nargs="?", type=Path, default=Path(__file__).parents[1])
    parser.add_argument("--against", type=Path, help="another checkout, counted beside")
    args = parser.parse_args()
    here = sizes(args.root)
    there = sizes(args.against) if args.against else {}
    head = ("what", "here", *(["there"] if there else []))
    print("|", " | ".join(head), "|\n|", " | ".join("---" for _ in head), "|")
    for name in dict.fromkeys((*here, *there)):
        row = (name, here.get(name, 0), *([there.get(name, 0)] if there else []))
        print("|", " | ".join(map(str, row)), "|")


if __name__ == "__main__":
    main()
