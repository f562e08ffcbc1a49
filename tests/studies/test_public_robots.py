"""The study of public descriptions: its table, and a run over a made-up checkout."""

from __future__ import annotations

import public_robots
from imported_files import hand


def test_a_made_up_checkout(tmp_path):
    (tmp_path / "owner+name").mkdir()
    path = hand(tmp_path / "owner+name")
    assert public_robots.checkout(tmp_path, "owner/name") == path.parent
    assert public_robots.checkout(tmp_path, "owner/other") is None
    result = public_robots.imported(path, [], shapes=False)
    motors, *fingers = result["outcome"].split()
    assert motors == "0+4"
    assert len(fingers) == 2
    row = {"repository": "owner/name", "path": path.name, "arguments": "", "expected": "0+1"}
    sentence, blocks = public_robots.report([row], {public_robots.key(row): result}, shapes=False)
    text = "\n".join([sentence, *blocks])
    assert "0 of 1 are as" in " ".join(text.split())
    path.write_text("<robot/>")
    assert public_robots.imported(path, [], shapes=False)["outcome"].startswith("error: ")
