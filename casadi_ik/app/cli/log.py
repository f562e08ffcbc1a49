"""`casadi-ik log ...`: logs as tables, in words, as pictures, as other files."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from casadi_ik import logs
from casadi_ik.app.cli import options as opt
from casadi_ik.app.cli.inputs import located, robot_of_log
from casadi_ik.app.cli.options import Option
from casadi_ik.app.cli.outputs import check_outputs, output, write_json
from casadi_ik.app.cli.table import Answer, Said, command
from casadi_ik.app.report import count_text, duration, fields, files, headline, indented, table
from casadi_ik.errors import InputError, MissingExtraError, UnknownNameError, printable
from casadi_ik.logs.container import ForeignLogError, NothingWrittenError
from casadi_ik.logs.events import SERIOUS, plain_name, quantity, told
from casadi_ik.logs.explanation import Matched, explain, matched, side_by_side
from casadi_ik.logs.repair import finish_log, merge_logs
from casadi_ik.logs.shards import log_files
from casadi_ik.logs.solve import OneSolve, one_solve
from casadi_ik.logs.tables import happenings

SHOWN = 12
"""How many of a list of names or numbers are shown."""

USUAL_EVENTS = ("PHASE_CHANGE", "LIMIT_LEFT", "RELEASED")
"""What happens in every solve and so is not told of each."""

TORN, EMPTY = (
    "killed while writing, or still at it (casadi-ik log finish)",
    "nothing in it is whole",
)
"""Why files of a study are named."""

LOGS = Option("FILE...", "logs, or folders of logs", key="files")
LOG = Option("FILE", "a log, or a folder of shards")
SOLVE = Option("--solve N", "number of the solve, from 1", read=opt.whole(1))
ONE_SOLVE = (
    Option(
        "[SOLVE]",
        "number of the solve, from 1 (default: the only one)",
        read=opt.whole(1),
        key="one",
    ),
    Option("--solve N", "the same", read=opt.whole(1)),
    Option("--method M", "method (default: the only one)"),
)
FILTERS = (
    Option("--method M", "of the solve"),
    SOLVE,
    Option("--status S", "of the solve, e.g. STALLED"),
    Option("--event E", "solves in which one happened, and those events, e.g. NEAR_SINGULAR"),
    Option("--phase P", "solves, iterations and events in it, e.g. hand-alignment"),
)
MOST = Option("--most N", "rows shown", 40)
KINDS = {".mcap": "viewer", ".parquet": "parquet", ".csv": "csv"}
"""What `log export` writes, by the name's end."""


@command(LOGS)
def info(said: Said) -> Answer:
    """Tell what logs hold: methods, solves, iterations, events, size and origin."""
    parts: list[RenderableType] = []
    for name in said.files:
        log = logs.open(name)
        about = log.info()
        parts += [_title(name), fields(_container(log, about)), _methods(log, about)]
        parts.append(fields(_origin(log)))
    return Answer(Group(*parts))


@command(LOGS, *FILTERS, MOST)
def solves(said: Said) -> Answer:
    """List solves and how they ended."""
    found = logs.open(said.files).solves(**_filters(said))
    parts: list[RenderableType] = []
    left = said.most
    for part in found.parts:
        shown = part.first(left)
        left -= len(shown)
        if len(shown):
            parts.append(Text(f"  {part.method}", "bold"))
            records = logs.Table("solve", (shown,)).records()
            for shard, of_shard in groupby(records, lambda record: record.get("shard")):
                parts += [] if shard is None else [Text(f"  from {shard}", "dim")]
                parts.append(_solve_rows(part, of_shard))
    return Answer(Group(*parts, _count(len(found), said.most, "solve")))


@command(LOGS, *FILTERS, MOST)
def events(said: Said) -> Answer:
    """List events: singularities, limits, stalls, ..."""
    found = logs.open(said.files).events(**_filters(said))
    numbers = ("solve", "iteration")
    rows = table(*numbers, "method", "phase", "what happened", right=numbers)
    for part in (each.first(said.most - len(rows.rows)) for each in found.parts):
        for number, event in zip(part.solve_id.tolist(), happenings(part), strict=True):
            text = Text(told(event), "yellow" if event.kind in SERIOUS else "")
            rows.add_row(str(number + 1), str(event.iteration + 1), part.method, event.phase, text)
    return Answer(Group(_only_last_wraps(rows), _count(len(found), said.most, "event")))


@command(LOG, *ONE_SOLVE)
def why(said: Said) -> Answer:
    """Explain one solve in words."""
    solve = _the_solve(said, logs.open(said.file))
    found = explain(solve)
    parts: list[RenderableType] = [headline(solve.success, solve.status, found.headline)]
    if solve.shard:
        parts.append(Text(f"  solve {solve.number + 1} of {solve.shard}"))
    for title, lines in found.parts.items():
        parts.append(Text(f"  {title}", "bold"))
        parts += [indented(line, width=4) for line in lines]
    return Answer(Group(*parts))


@command(
    LOG,
    *ONE_SOLVE,
    Option(
        "--out FILE.png",
        "where to (default: named after log, method and solve, in this folder)",
        read=opt.file_name(".png"),
    ),
    Option(
        "--range FIRST LAST",
        "iterations drawn, from 1; long runs hide what happens at their beginning (default: all)",
        read=opt.each(opt.whole(1)),
    ),
)
def plot(said: Said) -> Answer:
    """Draw how one solve went (needs 'casadi-ik[plots]')."""
    with located("log plot", (MissingExtraError,)):
        from casadi_ik.app.pictures import draw_convergence
    log = logs.open(said.file)
    solve = _the_solve(said, log)
    named = Path(f"{Path(said.file).stem}-{solve.method}-{solve.solve_id + 1}.png")
    file = said.out or named
    check_outputs({"--out": file}, inputs=[Path(said.file)])
    chosen = {"method": solve.method, "solve": solve.solve_id}
    with located(f"{said.file}: solve {solve.solve_id + 1}"):
        draw_convergence(
            log.iterations(**chosen),
            file,
            events=log.events(**chosen),
            tolerance=min(solve.tolerances, key=lambda each: each.position),
            span=tuple(said.range) if said.range else None,
            title=f"{solve.method} · solve {solve.solve_id + 1} · {solve.iterations} iterations"
            f" · {solve.status}",
        )
    return Answer(Group(*files({"plot": file})))


@command(
    LOGS,
    Option("--solve N", "one solve, by its number with the first method", read=opt.whole(1)),
    Option("--methods M M", "which two; last on the line (default: the only two)"),
)
def compare(said: Said) -> Answer:
    """Compare two methods on the same targets: one side by side, many in numbers."""
    opened = [logs.open(name) for name in said.files]
    first, second = _two_methods(opened, said.methods)
    pairs = matched(opened, first, second)
    if said.solve is not None:
        pairs = pairs.of_first(said.solve - 1)
    if len(pairs) == 0:
        asked = "" if said.solve is None else f" of solve {said.solve}"
        where = ", ".join(said.files)
        raise InputError(f"{where}: {first} and {second}: no target{asked} in common")
    if len(pairs) > 1:
        return Answer(_many_compared(pairs))
    (pair,) = pairs.pairs
    both = [one_solve(each.log, each.solve_id, each.method) for each in pair]
    rows = table("", *(f"{each.method}, solve {each.solve_id + 1}" for each in both))
    for line in side_by_side(*both):
        rows.add_row(line.what, line.first, line.second)
    return Answer(rows)


@command(
    LOGS,
    opt.out("REPORT.html", "where to"),
    Option("--title TEXT", "of the page (default: what the log is called)"),
    Option("--most N", "solves listed with their stories", 200),
)
def report(said: Said) -> Answer:
    """Write a study as a page that needs nothing but a browser (needs 'casadi-ik[plots]').

    It has success, time and iterations by method and targets, failures by reason, the
    hardest solves with their stories, to filter and sort, and where solves fail. Several
    logs of one robot are told as one.
    """
    with located("log report", (MissingExtraError,)):
        from casadi_ik.app.pictures import study_page
    paths = [Path(name) for name in said.files]
    log = logs.open(paths)
    check_outputs({"--out": said.out}, inputs=paths)
    title = said.title or ", ".join(path.stem for path in paths)
    page = study_page(log, title, said.most)
    with output(said.out) as part:
        part.write_text(page, encoding="utf-8")
    count = count_text(sum(len(part) for part in log.solves().parts), "solve")
    return Answer(Group(Text(f"  {count}"), *files({"page": said.out})))


@command(
    LOG,
    *FILTERS,
    Option("--what iterations|solves|events", "rows of a table", "iterations"),
    Option(
        "--to viewer|parquet|csv",
        f"kind of file (default: what --out ends in: {', '.join(KINDS)})",
    ),
    Option("--robot R", "for a viewer: a shipped name or a YAML file (default: the log's)"),
    opt.out("FILE", "where to", opt.file_name()),
)
def export(said: Said) -> Answer:
    """Write tables, or a file for a viewer.

    VIEW.mcap, for Foxglove (app.foxglove.dev) and Lichtblick: one solve with the
    robot, its frames, joints, contacts, phases and events, 10 ms an iteration; needs
    'casadi-ik[viewer]'. Beside it VIEW.layout.json is written, a layout to import
    there.
    TABLE.parquet or TABLE.csv: rows of numbers, needs 'casadi-ik[dataframes]'.
    """
    kind = said.to or KINDS.get(said.out.suffix.lower())
    if kind is None:
        raise InputError(
            f"--out: found {str(said.out)!r}, expected {', '.join(KINDS)}, or say --to"
        )
    if kind == "viewer":
        return _exported_view(said, said.out)
    check_outputs({"--out": said.out}, inputs=[Path(said.file)])
    log = logs.open(said.file)
    with located("log export", (MissingExtraError,)):
        frame = getattr(log, said.what)(**_filters(said)).frame()
    with output(said.out) as part:
        (frame.write_parquet if kind == "parquet" else frame.write_csv)(part)
    about = {"rows": f"{frame.height} {said.what}", "columns": str(frame.width)}
    return Answer(Group(fields(about), *files({kind: said.out})))


@command(LOGS)
def finish(said: Said) -> Answer:
    """Repair logs in place whose writer was killed.

    In a folder those in which nothing is whole are named and left as they are.
    """
    parts: list[RenderableType] = []
    for path, _ in (found := log_files(said.files)):
        try:
            done = finish_log(path)
        except NothingWrittenError:
            if len(found) == 1:
                raise
            about = {"done": f"left as it is: {EMPTY}"}
        except ForeignLogError as error:
            if len(found) == 1:
                raise
            about = {"done": f"left as it is: {str(error).removeprefix(f'{path}: ')}"}
        else:
            cut = f"{_size(done.cut)} of a torn tail cut" if done.cut else "a summary was written"
            about = {
                "done": f"finished, {cut}" if done.changed else "whole already",
                "holds": f"{count_text(done.chunks, 'chunk')}, "
                f"{count_text(done.messages, 'message')}",
            }
        parts += [_title(str(path)), fields(about)]
    return Answer(Group(*parts))


@command(LOGS, opt.out("FILE.mcap", "the log that has all of it"))
def merge(said: Said) -> Answer:
    """Join the shards of a study, without recompressing."""
    check_outputs({"--out": said.out}, inputs=[path for path, _ in log_files(said.files)])
    done = merge_logs(said.files, said.out)
    about = {
        "shards": str(done.shards),
        "solves": ", ".join(f"{count} of {name}" for name, count in done.solves.items()) or "none",
        "messages": str(done.messages),
        "size": _size(done.size),
        "left out": _named(done.left_out, EMPTY),
    }
    return Answer(Group(fields(about), *files({"log": said.out})))


def _exported_view(said: Said, file: Path) -> Answer:
    with located("log export", (MissingExtraError,)):
        from casadi_ik.app.log_viewers import layout_of, write_view
    layout = file.with_suffix(".layout.json")
    check_outputs({"--out": file, "the layout": layout}, inputs=[Path(said.file)])
    log = logs.open(said.file)
    solve = _the_solve(said, log)
    robot = robot_of_log(log, said.file, said.robot or solve.robot)
    write_view(file, solve, robot)
    write_json(layout, layout_of(solve, robot))
    return Answer(Group(*files({"viewer": file, "layout": layout})))


def _the_solve(said: Said, log: logs.Log) -> OneSolve:
    """The solve that was asked for.

    Raises:
        LogError: The log is damaged.
        UnknownNameError: There is no such solve, or several; the message names the file.
    """
    number = getattr(said, "one", None)
    try:
        asked = said.solve if number is None else number
        return one_solve(log, asked, said.method, counted_from=1)
    except UnknownNameError as error:
        where = "" if said.file in str(error) else f"{said.file}: "
        raise UnknownNameError(f"{where}{error}") from error


def _filters(said: Said) -> dict[str, Any]:
    """The filters of a command as `Log` takes them."""
    found = {one.name.strip("-"): getattr(said, one.attribute) for one in FILTERS}
    return found if said.solve is None else {**found, "solve": said.solve - 1}


def _title(name: str) -> Text:
    return Text(name, "bold", no_wrap=True, overflow="ignore")


def _only_last_wraps(rows: Table) -> Table:
    for column in rows.columns[:-1]:
        column.no_wrap = True
    return rows


def _count(count: int, most: int, thing: str) -> RenderableType:
    if count <= most:
        return Text(f"  {count_text(count, thing)}")
    return Text(f"  the first {most} of {count_text(count, thing)} (--most shows more)")


def _named(items: Sequence[Any], why_named: str = "") -> str:
    """How many there are, the first few, and why they are named; "" if there are none."""
    if not items:
        return ""
    more = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    count = f"{len(items)}: " if len(items) > 1 else ""
    text = f"{count}{', '.join(map(str, items[:SHOWN]))}{more}"
    return f"{text}: {why_named}" if why_named else text


def _size(count: int) -> str:
    """Bytes in the unit that suits them."""
    for unit, scale in (("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.3g} {unit}"
    return f"{count} bytes"


def _solve_rows(part: logs.MethodRows, records: Iterable[Mapping[str, Any]]) -> Table:
    """A row per solve of one method; restarts only if there are any."""
    restarts = ["restarts"] if part.rows["restarts"].any() else []
    numbers = ("iterations", *restarts, "mm off", "deg off", "time")
    rows = table("solve", "status", *numbers, "events", right=("solve", *numbers))
    for record in records:
        rows.add_row(
            str(record["solve_id"] + 1),
            Text(record["status"], "green" if record["success"] else "red"),
            str(record["iterations"]),
            *(str(record[name]) for name in restarts),
            _worst(record["position_error"], 1e3),
            _worst(record["angle_error"], math.degrees(1.0)),
            duration(record["time"]),
            _tally(part.labels["events"], record) + ("" if record["kept"] else " (totals only)"),
        )
    return _only_last_wraps(rows)


def _worst(values: Any, factor: float) -> str:
    """The largest error of all fingers; "free" if none has one."""
    known = [value for value in np.ravel(values).tolist() if not math.isnan(value)]
    return f"{factor * max(known):.2f}" if known else "free"


def _tally(kinds: Sequence[str], record: Mapping[str, Any]) -> str:
    """How often what happened in a solve, by the names of `--event`; what was held."""
    counts = zip(kinds, np.ravel(record["events"]).tolist(), strict=True)
    found = [f"{count} {kind}" for kind, count in counts if count and kind not in USUAL_EVENTS]
    return ", ".join(found + [f"{name} held" for name in record.get("fixed_mask", ())])


def _container(log: logs.Log, about: logs.LogInfo) -> dict[str, str]:
    """Robot, size and what is wrong with files."""
    iterations = sum(counts["iteration"] for counts in about.counts.values())
    each_takes = f", {about.size / iterations:.0f} bytes/iteration" if iterations else ""
    packed = f"{about.chunks}, compression {about.compression}"
    if about.compressed:
        packed += f" ({about.uncompressed / about.compressed:.1f} times smaller)"
    attached = (f"{name} ({_size(length)})" for name, length in about.attachments.items())
    sources = log.sources.names
    return {
        "robot": about.robot,
        "shards": _named(sources) if len(sources) > 1 else "",
        "size": f"{_size(about.size)}{each_takes}",
        "chunks": packed,
        "attached": ", ".join(attached) or "nothing",
        "unfinished": _named(about.unfinished, TORN),
        "left out": _named(about.left_out, EMPTY),
    }


def _methods(log: logs.Log, about: logs.LogInfo) -> RenderableType:
    right = ("solves", "iterations")
    rows = table("method", *right, "status", "smallest sigma", "events", right=right)
    for method, counts in about.counts.items():
        found = log.solves(method=method)
        tallies = []
        for table_of, field in ((found, "status"), (log.events(method=method), "kind")):
            tally = Counter(name for part in table_of.parts for name in part.readable(field))
            lines = (f"{count} {name}" for name, count in tally.most_common())
            tallies.append("\n".join(lines) or "none")
        numbers = str(counts["solve"]), str(counts["iteration"])
        rows.add_row(method, *numbers, tallies[0], _smallest(found), tallies[1])
    return rows


def _smallest(solves: logs.Table) -> str:
    """Return the smallest singular value of every Jacobian, or that it was not measured."""
    field, lowest = "lowest_sigma", dict[str, float]()
    for part in solves.parts:
        for i, name in enumerate(part.labels.get(field, ()) if field in part.names else ()):
            values = [lowest.get(name, math.nan), *part.rows[field][:, i].tolist()]
            lowest[name] = float(np.fmin.reduce(values))
    lines = (
        f"{plain_name(name)} {'not measured' if math.isnan(value) else f'{value:.2g}'}"
        for name, value in lowest.items()
    )
    return "\n".join(lines) or "not measured"


def _origin(log: logs.Log) -> dict[str, str]:
    """The metadata that says where a log is from, as text by name; all that its shards say."""
    told = [_told(source.metadata) for source in log.sources.sources]
    pairs = {}
    for name in dict.fromkeys(name for each in told for name in each):
        texts = list(dict.fromkeys(each.get(name, "none") for each in told))
        more = f" | {len(texts) - SHOWN} more" if len(texts) > SHOWN else ""
        differ = len(texts) > 1 and name != "created"
        text = f"{' | '.join(texts[:SHOWN])}{more} (by shard)" if differ else texts[0]
        pairs[printable(name, 60)] = printable(text, 2000)
    return pairs


def _told(metadata: Mapping[str, Any]) -> dict[str, str]:
    """The metadata of one shard, as text by name."""
    packages = {"casadi_ik": metadata.get("code_version"), "python": metadata.get("python")}
    packages |= metadata.get("packages", {})
    parameters = metadata.get("parameters", {})
    told = {
        "created": str(metadata.get("created")),
        "seed": str(metadata.get("seed")),
        "machine": _flat(metadata.get("machine", {})),
        "versions": " ".join(f"{name} {value}" for name, value in packages.items()),
        **({} if "scene" in parameters else {"collision": "not checked"}),
    }
    for name, value in parameters.items():
        told[name.replace("_", " ")] = _tolerance(value) if name == "tolerance" else _flat(value)
    return told


def _tolerance(value: Any) -> str:
    """Tolerances by finger in millimetres and degrees; said once if they are the same for all."""
    try:
        texts = {
            finger: f"{quantity(each['position'], 'm')} and {quantity(each['angle'], 'rad')}"
            for finger, each in value.items()
        }
    except (AttributeError, TypeError, KeyError, ValueError, OverflowError):
        return _flat(value)  # not as this package writes it
    one = set(texts.values())
    return one.pop() if len(one) == 1 else _flat(texts)


def _flat(value: Any) -> str:
    """JSON on one line, a mapping as "name value, ..."."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_flat(item)}" for key, item in value.items()) or "none"
    if isinstance(value, float):
        return f"{value:.6g}"
    return value if isinstance(value, str) else json.dumps(value)


def _two_methods(opened: list[logs.Log], asked: list[str] | None) -> tuple[str, str]:
    held = list(dict.fromkeys(method for log in opened for method in log.methods))
    for method in asked or ():
        if method not in held:
            raise InputError(f"--methods: found {method!r}, the logs hold {', '.join(held)}")
    both = asked or held
    if len(both) != 2:
        raise InputError(
            f"the logs hold {', '.join(held) or 'no method'}, expected two methods (say --methods)"
        )
    return both[0], both[1]


def _many_compared(pairs: Matched) -> RenderableType:
    success = np.array([[each.success for each in pair] for pair in pairs.pairs])
    iterations = np.array([[each.iterations for each in pair] for pair in pairs.pairs])
    times = np.array([[each.time for each in pair] for pair in pairs.pairs])
    rows = table("method", "solved", "iterations where both", "time where both", right=("solved",))
    both = success.all(axis=1)
    lines = [f"solved by both {both.sum()}, by neither {(~success.any(axis=1)).sum()}"]
    for i, name in enumerate((pairs.first, pairs.second)):
        means = ("-", "-")
        if both.any():
            means = (f"{iterations[both, i].mean():.1f}", f"{1e3 * times[both, i].mean():.3g} ms")
        rows.add_row(name, f"{success[:, i].sum()} of {len(success)}", *means)
        only = np.flatnonzero(success[:, i] & ~success[:, 1 - i]).tolist()
        numbers = _named([pairs.pairs[j][0].solve_id + 1 for j in only]).partition(": ")
        named = f" (solve {numbers[2] or numbers[0]})" if only else ""
        lines.append(f"only by {name}: {len(only)}{named}")
    return Group(rows, *(Text(f"  {line}") for line in lines))
