"""The page of tested cases names tests that exist."""

from __future__ import annotations

import re

from processes import ROOT


def test_every_named_test_exists():
    path, missing = "", []
    lines = (ROOT / "docs" / "tried.md").read_text(encoding="utf-8").splitlines()
    rows = [line for line in lines if line.startswith("| ")][1:]
    for row in rows:
        for word in re.findall(r"`([^`]*)`", row.rsplit("|", 2)[-2]):
            file, _, name = word.partition("::")
            path = file or path
            files = [
                folder / path for folder in (ROOT / "tests", ROOT) if (folder / path).is_file()
            ]
            if not files or f"def {name}" not in files[0].read_text(encoding="utf-8"):
                missing.append(word)
    assert len(rows) > 30
    assert missing == []
