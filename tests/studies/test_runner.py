"""The study runner resumes after any interruption, with equal results on all workers."""

from __future__ import annotations

import dataclasses
import math
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import small_study
from dask_processes import scheduler_process, worker_process
from distributed.versions import get_versions
from processes import POSIX, python
from runner.report import (
    interval_text,
    markdown_table,
    mean_metric,
    median_metric,
    rate_metric,
)
from runner.study import STUDY_FILE, claim, missing, read_results, run

import casadi_ik as ik
from casadi_ik.integrations import batches

STUDY = small_study.STUDY
FOLDERS = os.pathsep.join((str(Path(small_study.__file__).parent), *sys.path))


def contents(folder: Path, study=STUDY) -> pl.DataFrame:
    """Return all results without the times, in order."""
    return read_results(study, folder).drop("time").sort("setting", "targets", "target")


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("done")
    run(STUDY, folder)
    return folder


def test_a_row_per_target_and_setting(done):
    table = contents(done)
    assert len(table) == 2 * 2 * STUDY.count
    keys = table.select("setting", "targets", "target")
    assert keys.is_duplicated().sum() == 0
    assert table["target"].n_unique() == STUDY.count
    assert table["success"].all()
    assert table["position_error_thumb"].max() < 5e-3
    assert set(table["status"]) == {"SOLVED"}
    assert set(table["limits"]) == {"enforce"}
    assert not list(done.rglob("*.part"))


def test_block_targets_are_independent(done):
    """Blocks and sets have different targets, and settings share them."""
    first, second = STUDY.sets
    q = STUDY.configurations(first, 0)
    np.testing.assert_array_equal(q, STUDY.configurations(first, 0))
    assert not np.array_equal(q, STUDY.configurations(first, 1))
    assert not np.array_equal(q, STUDY.configurations(second, 0))
    larger_study = dataclasses.replace(STUDY, count=5 * STUDY.count)
    np.testing.assert_array_equal(q, larger_study.configurations(first, 0))


def test_jobs_change_nothing(done, tmp_path):
    run(STUDY, tmp_path, jobs=2)
    assert contents(tmp_path).equals(contents(done))


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """Address of a scheduler without workers."""
    with scheduler_process() as (_, address):
        yield address


def test_a_dask_cluster_without_workers_or_scheduler_is_refused(scheduler, tmp_path, monkeypatch):
    monkeypatch.setattr(batches, "CLUSTER_TIMEOUT", 1)
    for address, missing_part in ((scheduler, "worker"), ("tcp://127.0.0.1:9", "scheduler")):
        with pytest.raises(ik.errors.InputError, match=f"no {missing_part}"):
            run(STUDY, tmp_path, dask=address)


def test_a_dask_cluster_needs_the_installed_package_only(done, scheduler, tmp_path):
    """Scheduler and worker start like in the documentation; the study is a program."""
    with worker_process(scheduler):
        ended = python(small_study.__file__, tmp_path, scheduler, path=FOLDERS)
        assert ended.returncode == 0, ended.stderr
    assert contents(tmp_path).equals(contents(done))
    assert len(list(tmp_path.rglob("*.mcap"))) == len(list(STUDY.blocks()))


def test_a_worker_with_another_version_is_named(monkeypatch):
    class Client:
        def wait_for_workers(self, n_workers: int, timeout: float) -> None: ...

        def get_versions(self, packages):
            versions = get_versions(packages)
            worker = {"packages": versions["packages"] | {"casadi-ik": "0.0.1"}}
            return {
                "client": versions,
                "scheduler": versions,
                "workers": {"tcp://worker:1": worker},
            }

    with pytest.raises(
        ik.errors.InputError, match=r"tcp://worker:1 has .*casadi-ik 0\.0\.1.*expected"
    ):
        batches._check_workers(Client(), "tcp://here:1", batches.REQUIRED_PACKAGES)  # type: ignore[arg-type]


@POSIX
def test_random_kills_lose_and_duplicate_nothing(done, tmp_path):
    """Two workers and their parent are killed repeatedly until the study is finished."""
    rng = random.Random(3)
    kills = 0
    command = [sys.executable, str(Path(small_study.__file__)), str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": FOLDERS}
    while not (tmp_path / STUDY_FILE).exists() or missing(STUDY, tmp_path):
        data_before = {path: path.read_bytes() for path in tmp_path.rglob("*.parquet")}
        process = subprocess.Popen(
            command, env=environment, stderr=subprocess.DEVNULL, start_new_session=True
        )
        not_before = time.monotonic() + rng.uniform(0.0, 2.0)
        while kills < 4 and process.poll() is None:
            # Only a process that has started to work is killed.
            file_count = len(list(tmp_path.rglob("*.parquet")))
            if time.monotonic() > not_before and file_count > len(data_before):
                os.killpg(process.pid, signal.SIGKILL)
                kills += 1
            time.sleep(0.002)
        process.wait()
        for path, content in data_before.items():
            assert path.read_bytes() == content, "what is done is not done again"
            assert not ik.logs.open(path.with_suffix(".mcap")).info().unfinished
    assert kills > 0
    assert contents(tmp_path).equals(contents(done))
    claim(STUDY, tmp_path)
    assert not list(tmp_path.rglob("*.part"))
    logs = [ik.logs.open(path) for path in tmp_path.rglob("*.mcap")]
    assert len(logs) == len(list(STUDY.blocks()))
    assert {len(log.solves()) for log in logs} == {STUDY.block}
    iterations = sum(len(log.iterations()) for log in logs)
    assert iterations == contents(tmp_path)["iterations"].sum()


def test_as_many_targets_as_are_asked_for(done, tmp_path):
    """A truncated block has the first targets of the whole one, and is completed later."""
    few = dataclasses.replace(STUDY, count=STUDY.block + 1, settings=STUDY.settings[:1])
    run(few, tmp_path)
    table = contents(tmp_path, few)
    assert len(table) == 2 * few.count
    first = contents(done, few).filter(pl.col("target") < few.count)
    assert table.equals(first)
    run(STUDY, tmp_path)
    assert contents(tmp_path).equals(contents(done))


def test_a_changed_seed_is_one_line(done):
    script = f"""
        import dataclasses, pathlib
        from runner import report, study
        import small_study as s
        changed = dataclasses.replace(s.STUDY, seed=1)
        report.program(lambda: study.run(changed, pathlib.Path({str(done)!r})))
    """
    ended = python("-c", script, path=FOLDERS)
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert "seed: results made with 0 are here, this study has 1" in ended.stderr


def test_the_logs_of_a_study_are_one_log(tmp_path):
    """The blocks of two settings are numbered from 0 and have samples of their own."""
    study = dataclasses.replace(STUDY, sets=STUDY.sets[:1], count=8)
    run(study, tmp_path / "study", log=ik.logs.Keep())
    merged = ik.logs.merge_logs(tmp_path / "study", tmp_path / "all.mcap")
    assert merged.shards == 4
    for log in map(ik.logs.open, (tmp_path / "study", merged.path)):
        assert log.solves().solve_id.tolist() == list(range(16))
        solve = ik.logs.one_solve(log, 9)
        assert (solve.shard, solve.number) == ("loose/random hands/00000.mcap", 1)
        assert solve.tolerances[0].position == study.settings[0].tolerance[0]
        assert ik.logs.one_solve(log, 0).tolerances[0].position == study.settings[1].tolerance[0]


def test_block_logs_keep_the_selected_solves(done, tmp_path):
    study = dataclasses.replace(STUDY, settings=STUDY.settings[:1])
    run(study, tmp_path, log=ik.logs.Keep(failed=True, singular=False, sample=0.25))
    assert contents(tmp_path, study).equals(contents(done, study))
    logs = sorted(tmp_path.rglob("*.mcap"))
    assert len(logs) == len(list(tmp_path.rglob("*.parquet"))) == len(list(study.blocks()))
    rows = 0
    for path in logs:
        log = ik.logs.open(path)
        assert len(log.solves()) == study.block, "totals of all"
        rows += len(log.iterations())
    iterations = contents(tmp_path, study)["iterations"].sum()
    assert 0 < rows < 0.5 * iterations, "iterations of a sample"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"seed": 8}, "seed: results made with 0 are here, this study has 8; use another folder"),
        ({"block": 3}, "block: results made with 4 are here"),
        ({"settings": (small_study.CHANGED,)}, "settings.loose: results made with"),
        ({"robot": "kuka_lwr_barrett_coupled"}, "robot: results made with"),
    ],
)
def test_different_settings_do_not_mix(done, change, says):
    data_before = (done / STUDY_FILE).read_bytes()
    with pytest.raises(ik.errors.InputError) as caught:
        run(dataclasses.replace(STUDY, **change), done)
    assert says in str(caught.value)
    assert (done / STUDY_FILE).read_bytes() == data_before


def test_a_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ik.errors.InputError, match="holds files but no study"):
        run(STUDY, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_wilson_interval():
    """The closed form has a known example: 8 of 10 gives 49.0 % to 94.3 %."""
    metric = rate_metric("x", 8, 10)
    assert (metric.value, metric.n, metric.better) == (80.0, 10, "higher")
    assert (round(metric.low, 1), round(metric.high, 1)) == (49.0, 94.3)
    assert rate_metric("x", 10, 10).high == 100
    assert rate_metric("x", 0, 10).low == 0
    assert 99.9 < rate_metric("x", 10_000, 10_000).low < 100
    assert math.isnan(rate_metric("x", 0, 0).value)


def test_means_and_medians(rng):
    values = rng.normal(5.0, 2.0, 400)
    mean, median = mean_metric("x", values, "ms"), median_metric("x", values, "ms")
    assert mean.value == pytest.approx(values.mean())
    assert mean.high - mean.low == pytest.approx(2 * 1.96 * 2 / 20, rel=0.1)
    assert median.low < median.value == np.median(values) < median.high
    assert mean_metric("x", [0.0, 0.0, 9.0], "ms").low == 0
    assert mean_metric("x", [-1.0, 0.0, 9.0], "ms").low < -1
    assert interval_text(mean_metric("x", [], "ms")) == "-"
    assert interval_text(mean_metric("x", [2.0], "ms")) == "2.0"


def test_wide_tables_are_divided_and_repeat_the_keys():
    rows = [["a", "x", *"123456789"], ["a", "y", *"123456789"]]
    text = markdown_table(list("ABcdefghijk"), rows)
    tables = [block.splitlines() for block in text.strip().split("\n\n")]
    heads = ["| A | B | c | d | e | f | g |", "| A | B | h | i | j | k |"]
    assert [table[0] for table in tables] == heads
    assert all(len(table) == 4 for table in tables)
    assert markdown_table(list("ABCDEFGH"), []).count("\n") == 2
