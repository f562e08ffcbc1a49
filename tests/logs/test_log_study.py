"""The folder of a study's logs is one log: numbers, origins, shards in which nothing is."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_up_solves import make_block
from mcap.reader import make_reader

import casadi_ik as ik
from casadi_ik.cli.main import main
from casadi_ik.errors import LogError
from casadi_ik.logs import Keep, Log, finish_log, merge_logs, one_solve
from casadi_ik.logs.container import MAGIC

Write = Callable[..., Path]

COUNTS = ([40, 30], [20, 50, 10], [60])
ALL_COUNTS = [count for counts in COUNTS for count in counts]
NAMES = ("loose/cup/00000.mcap", "loose/cup/00001.mcap", "tight/cup/00000.mcap")


@pytest.fixture
def study(write: Write, tmp_path: Path) -> Path:
    """Three shards in two settings, each counting from 0, with a sample of its own."""
    folder = tmp_path / "study"
    for i, (name, counts) in enumerate(zip(NAMES, COUNTS, strict=True)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        block = make_block(*counts, first=100 * i)  # so that no two solves are the same
        tolerance = {"thumb": {"position": 1e-3 if "tight" in name else 5e-3}}
        numbered = make_block(*counts)
        numbered.batch.q[:] = block.batch.q
        write(
            numbered,
            name=f"study/{name}",
            keep=Keep(sample=1.0, seed=i),
            parameters={"tolerance": tolerance},
            urdf="<robot/>",
        )
    return folder


def rows_by_solve(log: Log) -> list[tuple[int, bytes]]:
    table = log.iterations()
    return [
        (number, table.rows[table.solve_id == number].tobytes())
        for number in np.unique(table.solve_id).tolist()
    ]


def test_numbers_go_on_from_shard_to_shard(study: Path) -> None:
    log = ik.logs.open(study)
    assert log.solves().solve_id.tolist() == [0, 1, 2, 3, 4, 5]
    assert log.solves().rows["solve_id"].tolist() == [0, 1, 2, 3, 4, 5]
    assert log.solves().rows["iterations"].tolist() == ALL_COUNTS
    assert [len(log.iterations(solve=i)) for i in range(6)] == ALL_COUNTS
    own = [ik.logs.open(study / name) for name in NAMES]
    expected = [rows for each in own for _, rows in rows_by_solve(each)]
    assert [rows for _, rows in rows_by_solve(log)] == expected
    assert set(log.events(solve=4).rows["solve_id"]) <= {4}
    frame = log.solves(solve=[1, 2, 5]).frame()
    assert frame["shard"].to_list() == list(NAMES)
    assert "shard" not in own[0].solves().frame().columns
    assert [record["shard"] for record in log.solves(solve=5).records()] == [NAMES[2]]


def test_where_a_solve_comes_from(study: Path, tmp_path: Path) -> None:
    """In the folder as in what was merged from it, and in what was merged from that."""
    merged = merge_logs([study], tmp_path / "all.mcap").path
    other = make_block(7, method="hand-first")
    with ik.logs.McapRecorder(
        tmp_path / "b.mcap", robot_name="made_up", urdf="<robot/>"
    ) as recorder:
        recorder.record(other)
    for log in (ik.logs.open(study), ik.logs.open(merged)):
        for number, (name, own) in enumerate(
            [
                (NAMES[0], 0),
                (NAMES[0], 1),
                (NAMES[1], 0),
                (NAMES[1], 1),
                (NAMES[1], 2),
                (NAMES[2], 0),
            ]
        ):
            solve = one_solve(log, number)
            assert (solve.shard, solve.number, solve.solve_id) == (name, own, number)
            position = 1e-3 if "tight" in name else 5e-3
            assert solve.parameters["tolerance"]["thumb"]["position"] == position
    keeps = ik.logs.open(merged).info().differs["keep"]
    assert [keep["seed"] for keep in keeps] == [0, 1, 2]


def test_a_study_is_merged(study: Path, tmp_path: Path) -> None:
    path = tmp_path / "all.mcap"
    merged = merge_logs(study, path)
    assert (merged.shards, merged.solves) == (3, {"enhanced-dls": 6})
    log, folder = ik.logs.open(path), ik.logs.open(study)
    assert rows_by_solve(log) == rows_by_solve(folder)
    for name in ("solves", "events"):
        ours, theirs = getattr(log, name)(), getattr(folder, name)()
        assert ours.rows.tobytes() == theirs.rows.tobytes()
        assert ours.solve_id.tolist() == theirs.solve_id.tolist()
    assert not finish_log(path).changed, "every record of it is verified"
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        messages = [
            (m.log_time, m.sequence) for _, c, m in reader.iter_messages(["/ik/enhanced-dls/solve"])
        ]
    assert [sequence for _, sequence in messages] == list(range(6))
    assert messages == sorted(messages)


def test_numbers_that_are_used_once_stay(write: Write, tmp_path: Path) -> None:
    write(make_block(5, first=3), make_block(5, first=9), name="a.mcap")
    write(make_block(6, first=5), name="b.mcap")
    for log in (
        ik.logs.open(tmp_path),
        ik.logs.open(merge_logs(tmp_path, tmp_path / "all").path),
    ):
        assert log.solves().solve_id.tolist() == [3, 5, 9]
        assert [one_solve(log, i).shard for i in (3, 5, 9)] == ["a.mcap", "b.mcap", "a.mcap"]
        assert one_solve(log, 5).number == 5


def test_the_same_solve_is_never_counted_twice(study: Path) -> None:
    """A merged log beside its shards, whatever numbers it has."""
    merge_logs(study, study / "all.mcap")
    with pytest.raises(
        LogError, match=r"00000\.mcap: solve 0 of enhanced-dls is in .*all\.mcap too"
    ):
        ik.logs.open(study).solves()


def test_shards_with_channels_in_another_order_are_merged(write: Write, tmp_path: Path) -> None:
    both = ("enhanced-dls", "hand-first")
    first = write(*(make_block(9, method=m) for m in both), name="a.mcap")
    second = write(*(make_block(8, first=1, method=m) for m in both[::-1]), name="b.mcap")
    third = write(make_block(7, first=2, method=both[1]), name="c.mcap")
    path = merge_logs([first, second, third], tmp_path / "all.mcap").path
    assert not finish_log(path).changed
    log = ik.logs.open(path)
    for method, expected in zip(both, ([9, 8], [9, 8, 7]), strict=True):
        assert log.solves(method=method).rows["iterations"].tolist() == expected
        shards = ik.logs.open([first, second, third])
        assert (
            log.iterations(method=method).rows.tobytes()
            == shards.iterations(method=method).rows.tobytes()
        )


@pytest.mark.parametrize("head", ["empty", "magic", "header", "metadata"])
def test_a_shard_in_which_nothing_is_whole_is_named_and_left_out(
    study: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, head: str
) -> None:
    whole = (study / NAMES[0]).read_bytes()
    length = {"empty": 0, "magic": 5, "header": 20, "metadata": 100}[head]
    torn = study / "loose" / "cup" / "00002.mcap"
    torn.write_bytes(whole[:length])
    log = ik.logs.open(study)
    assert len(log.solves()) == 6
    assert log.info().left_out == (torn,)
    (line,) = caplog.messages
    assert line.startswith(f"{torn}: ")
    assert line.endswith("; left out, nothing in it is whole")
    assert merge_logs(study, tmp_path / "all.mcap").left_out == (torn,)
    with pytest.raises(LogError, match=rf"^{torn}: "):
        ik.logs.open(torn)


def test_a_shard_of_which_something_is_whole_is_read_or_finished_first(
    study: Path, tmp_path: Path
) -> None:
    shard = study / NAMES[1]
    shard.write_bytes(shard.read_bytes()[:-10])
    assert len(ik.logs.open(study).solves()) == 6
    with pytest.raises(LogError, match=rf"^{shard}: .*log finish"):
        merge_logs(study, tmp_path / "all.mcap")
    assert main(["log", "finish", str(study)]) == 0
    assert merge_logs(study, tmp_path / "all.mcap").solves == {"enhanced-dls": 6}


def test_what_the_shell_says(
    study: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (study / "empty.mcap").write_bytes(b"")
    (study / ".all.1234.part.mcap").write_bytes(b"the work of a merge that was killed")

    def said(*words: object) -> str:
        assert main(["log", *map(str, words)]) == 0
        return " ".join(capsys.readouterr().out.split())

    info = said("info", study)
    assert info.startswith(str(study))
    assert f"shards 3: {', '.join(NAMES)}" in info
    # A long path is folded in the middle of a word.
    assert "empty.mcap:nothinginitiswhole" in info.replace(" ", "")
    assert "thumb position 0.005 | thumb position 0.001 (by shard)" in info
    solves = said("solves", study)
    assert "6 solves" in solves
    assert solves.index(f"from {NAMES[1]}") < solves.index(f"from {NAMES[2]}")
    assert f"solve 1 of {NAMES[1]}" in said("why", study, 3)
    merged = said("merge", study, "--out", tmp_path / "all.mcap")
    assert "6 of enhanced-dls" in merged
    assert "empty.mcap:nothinginitiswhole" in merged.replace(" ", "")
    assert f"solve 1 of {NAMES[1]}" in said("why", tmp_path / "all.mcap", 3)


def test_only_the_beginning_of_a_file(tmp_path: Path) -> None:
    """A folder of nothing but such files holds no log."""
    for i, data in enumerate((b"", MAGIC[:3], MAGIC)):
        (tmp_path / f"{i}.mcap").write_bytes(data)
    with pytest.raises(LogError, match=r"0\.mcap: nothing in it is whole, nor in 2 others"):
        ik.logs.open(tmp_path)
