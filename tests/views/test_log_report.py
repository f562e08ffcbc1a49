"""The log of a study as one page: complete, self-contained, and safe for any name."""

from __future__ import annotations

from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from commands import main

import casadi_ik as ik


class Page(HTMLParser):
    """Return the parts of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.cells: list[list[str]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.sources += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag == "tr":
            self.cells.append([])

    def handle_data(self, data: str) -> None:
        if self.tags[-1:] == ["td"]:
            self.cells[-1].append(data)
            self.tags.append("")


@pytest.fixture(scope="module")
def study(robot: ik.ArmHand, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sets of targets of one method, one of them out of reach."""
    folder = tmp_path_factory.mktemp("study")
    rng = np.random.default_rng(6)
    for name, scale in (("near", 1.0), ("<i>far</i>", 3.0)):
        (folder / name).mkdir(parents=True)
        points, normals = robot.contacts(robot.random(rng, 12))
        path = folder / name / "0000.mcap"
        ik.Solver(robot).solve_batch(points * scale, normals, log=path)
    return folder


def report(study: Path, out: Path, *options: str) -> str:
    """Return the text of the page that the command writes."""
    assert main(["log", "report", str(study), "--out", str(out), *options]) == 0
    return out.read_text(encoding="utf-8")


def test_page(study: Path, tmp_path: Path) -> None:
    title = "<script>alert(1)</script>"
    text = report(study, tmp_path / "study.html", "--title", title, "--most", "24")
    assert "24 solves" in text
    page = Page(text)
    assert page.tags.count("script") == 1
    assert "&lt;script&gt;alert(1)" in text
    assert "i" not in page.tags
    assert all(source.startswith("data:image/png") for source in page.sources)
    assert page.tags.count("img") == 2
    assert text.count('<tbody class="solve"') == 24
    assert page.tags.count("svg") == 24
    rows = {row[1]: row for row in page.cells if len(row) > 8}
    assert rows["near"][2:4] == ["12", "100.00"]
    assert rows["<i>far</i>"][2:4] == ["12", "0.00"]
    # Unsolved targets are listed first, and counted by reason.
    first = text.index('<tbody class="solve"')
    assert 'data-status="STALLED"' in text[first : first + 200]
    assert sum(int(row[0]) for row in page.cells if len(row) == 4) == 12


def test_most(study: Path, tmp_path: Path) -> None:
    text = report(study, tmp_path / "study.html", "--most", "5")
    assert text.count('<tbody class="solve"') == 5
    assert "The 5 hardest solves" in text


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["nowhere.mcap", "--out", "a.html"], "nowhere.mcap"),
        (["STUDY", "--out", "a.txt"], ".html"),
    ],
)
def test_refusals(
    words: list[str],
    says: str,
    study: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    named = [str(study) if word == "STUDY" else word for word in words]
    assert main(["log", "report", *named]) == 2
    assert says in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
