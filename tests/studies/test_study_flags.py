"""What a study varies is on its command line, and the report says what was asked for."""

from __future__ import annotations

from pathlib import Path

import ar10_gains
import calibration
import closed_chain_singularities
import closed_chain_workspace
import numpy as np
import proofs
import pytest
import virtual_joint_range

import casadi_ik as ik


def test_the_turns_of_the_virtual_joint(tmp_path: Path) -> None:
    arguments = ["--count", "30", "--steps", "8", "--out", str(tmp_path)]
    virtual_joint_range.main(arguments)
    text = (tmp_path / "virtual_joint_range" / "README.md").read_text()
    assert f"`python studies/virtual_joint_range.py {' '.join(arguments)}`" in text
    assert "in steps of 45 deg" in text
    with pytest.raises(ik.errors.InputError, match="--steps: found 7, expected an even number"):
        virtual_joint_range.main(["--steps", "7"])


def test_palms_and_grasp_of_the_workspace(tmp_path: Path) -> None:
    given = ["--count", "30", "--palms", "12", "--grasp", "mug", "--out", str(tmp_path)]
    closed_chain_workspace.main(given)
    text = (tmp_path / "closed_chain_workspace" / "README.md").read_text()
    assert "12 palms uniform" in text
    assert "`mug`" in text


def test_what_counts_as_near_singular(tmp_path: Path) -> None:
    shares = []
    for near in ("10", "1000"):
        given = ["--count", "100", "--near", near, "--out", str(tmp_path)]
        closed_chain_singularities.main(given)
        text = (tmp_path / "closed_chain_singularities" / "README.md").read_text()
        assert f"condition above {near})" in text
        shares.append(float(text.split("arm 7 and 6) ")[1].split(" %")[0]))
    assert shares[0] > shares[1]


def test_gains_and_resolution_of_the_sliders(tmp_path: Path) -> None:
    robot, rng = ik.load_robot("ar10"), np.random.default_rng(0)
    text = ar10_gains.index_pose(robot, tmp_path, 1, rng, (0.3, 1.0), 3e-4)
    assert "model, sliders in 0.3 mm: left over 1 goals" in text
    assert "| 0.3 |  |  |" in text  # the paper has no such gain
    assert "| 1 | -0.60, -0.71 | 0.93 |" in text
    assert ar10_gains.within(robot, 0.5) == pytest.approx((robot.lower + robot.upper) / 2)


def test_parts_of_outliers(tmp_path: Path) -> None:
    for wrong in (["0.3", "0.2"], ["0", "0.2"], ["0.1", "1"]):
        with pytest.raises(
            ik.errors.InputError, match=r"--outliers: found .*, expected 0 < FEW < MANY < 1"
        ):
            calibration.main(["--outliers", *wrong, "--out", str(tmp_path)])


def test_how_far_impossible_is_beyond(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(proofs, "CLASSES", proofs.CLASSES[:3])  # one of them for this hand
    given = ["--robot", "ar10", "--count", "0", "--impossible", "2", "--out", str(tmp_path)]
    report = tmp_path / "report"
    proofs.main([*given, "--report", str(report), "--beyond", "40", "15"])
    text = " ".join((report / "report.md").read_text().split())
    assert "does not solve with 40 mm and 15 deg more than the usual 5 mm and 3 deg" in text
    assert sorted(path.name for path in tmp_path.iterdir()) == ["beyond 40 mm 15 deg", "report"]
