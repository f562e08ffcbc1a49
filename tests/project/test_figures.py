"""The README, the paper, the site and the reports state the same figures."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from processes import ROOT

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))

from building.speed import label, means

RESULTS = ROOT / "studies" / "results"
PAGES = [
    ROOT / "README.md",
    ROOT / "paper" / "paper.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]


def text_of(path: Path) -> str:
    return " ".join(path.read_text(encoding="utf-8").split())


def report(name: str) -> str:
    return text_of(RESULTS / name / "report.md")


def first(pattern: str, text: str) -> str:
    match = re.search(pattern, text)
    assert match, pattern
    return match[1]


def missed_targets() -> str:
    return first(r"\| missed, 5 mm, 3 deg \| (0 of [\d,]+) \|", report("any_robot"))


def collision_free() -> str:
    table = report("collision").partition("## Choice")[2].partition("## Others")[0]
    counts = re.findall(r"\| (\d+) of (\d+) \|", table)
    solved, solvable = (sum(map(int, column)) for column in zip(*counts, strict=True))
    return f"{solved:,} of {solvable:,}"


def batch_time() -> str:
    return first(r"\| Python, batch \| ([\d.]+) \|", report("exported"))


def noise() -> str:
    table = report("noise").partition("(now)")[2]
    return f"{float(first(r'[|] 4 mm, 2 deg [|] ([0-9.]+) [|]', table)):.1f}"


PROOFS = r"(?:False proofs of UNREACHABLE \| 0 of|None of) ([\d,]+)"
"""Number of reachable targets that the study of proofs checked."""


def test_readme_agrees_with_the_reports() -> None:
    readme = text_of(ROOT / "README.md")
    assert f"5 mm and 3° | {missed_targets()} |" in readme
    assert f"{missed_targets().split()[-1]} reachable targets" in readme
    assert f"Collision-free solutions found | {collision_free()} |" in readme
    assert f"| {float(batch_time()):.0f} µs |" in readme
    assert f"4 mm and 2° of noise | {noise()} % |" in readme


def test_paper_agrees_with_the_reports() -> None:
    paper = text_of(ROOT / "paper" / "paper.md")
    assert f"none of {missed_targets().split()[-1]} reachable targets" in paper
    assert f"takes {float(batch_time()):.0f} microseconds" in paper
    ours, *other_means = means().values()
    assert label(ours) in paper
    assert f"{label(min(other_means)).split()[0]} to {label(max(other_means))}" in paper


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        (
            PROOFS + r"(?= reachable|\]| \|)",
            lambda: first(r"([\d,]+) targets, 0 false", report("proofs")),
        ),
        (r"(\d+) arms(?:,| and) \d+ hands", lambda: str(len(built_in("arms")))),
        (r"\d+ arms(?:,| and) (\d+) hands", lambda: str(len(built_in("hands")))),
    ],
)
def test_pages_state_one_figure(pattern: str, expected: Callable[[], str]) -> None:
    stated = {page.name: set(re.findall(pattern, text_of(page))) for page in PAGES}
    stated = {name: values for name, values in stated.items() if values}
    assert {"README.md", "paper.md"} <= stated.keys()
    assert stated == {name: {expected()} for name in stated}


def built_in(kind: str) -> list[Path]:
    return sorted((ROOT / "models" / kind).glob("*.yaml"))


def test_citation_names_no_release_date() -> None:
    """The date is added by the commit of a release, together with its entry in the changelog."""
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    heading = f"## [{citation['version']}] - "
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert ("date-released" in citation) == (heading in changelog)


JOSS_SECTIONS = """Summary; Statement of need; State of the field; Software design;
Research impact statement; AI usage disclosure; Acknowledgements; References"""
"""Headings that the Journal of Open Source Software requires, in order."""


def test_paper_has_the_form_of_its_journal() -> None:
    _, header, body = (ROOT / "paper" / "paper.md").read_text(encoding="utf-8").split("---\n", 2)
    fields = {"title", "tags", "authors", "affiliations", "date", "bibliography"}
    assert fields <= yaml.safe_load(header).keys()
    assert re.findall(r"^# (.*)$", body, re.MULTILINE) == re.split(r";\s+", JOSS_SECTIONS)
    assert 750 <= len(re.sub(r"<!--.*?-->", "", body, flags=re.DOTALL).split()) <= 1750
    cited = set(re.findall(r"@(\w+)", body))
    entries = (ROOT / "paper" / "paper.bib").read_text(encoding="utf-8")
    assert cited == set(re.findall(r"^@\w+\{(\w+),", entries, re.MULTILINE))
