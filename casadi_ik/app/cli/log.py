"""Commands `casadi-ik log ...`: tables, explanations, plots, reports and exports of logs."""

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
from casadi_ik.app.cli.table import Arguments, CommandResult, command
from casadi_ik.app.report import count_text, duration, fields, files, headline, indented, table
from casadi_ik.errors import InputError, MissingExtraError, UnknownNameError, printable
from casadi_ik.logs.container import ForeignLogError, NothingWrittenError
from casadi_ik.logs.events import SERIOUS, describe
from casadi_ik.logs.explanation import MatchedTargets, compare_solves, explain, match_targets
from casadi_ik.logs.repair import finish_log, merge_logs
from casadi_ik.logs.shards import log_files
from casadi_ik.logs.solve import SolveRecord, one_solve
from casadi_ik.logs.tables import events_of
from casadi_ik.logs.wording import format_quantity, plain_name

MAX_ITEMS = 12
"""Maximum number of names or numbers that a list shows."""

ROUTINE_EVENTS = ("PHASE_CHANGE", "LIMIT_LEFT", "RELEASED")
"""Kinds of events that occur in every solve, which the list of solves omits."""

INCOMPLETE = "writer was killed or is still running (casadi-ik log finish)"
"""Explanation of files without a summary."""

EMPTY = "no complete chunk"
"""Reason for omitted files of a study."""

LOGS = Option("FILE...", "logs, or folders of logs", key="files")
LOG = Option("FILE", "log, or folder of shards")
SOLVE = Option("--solve N", "number of the solve, from 1", parse=opt.integer(1))
SINGLE_SOLVE = (
    Option(
        "[SOLVE]",
        "number of the solve, from 1 (default: the only one)",
        parse=opt.integer(1),
        key="number",
    ),
    Option("--solve N", "number of the solve, from 1", parse=opt.integer(1)),
    Option("--method M", "method (default: the only one)"),
)
FILTERS = (
    Option("--method M", "only solves of this method"),
    SOLVE,
    Option("--status S", "only solves with this status, e.g. STALLED"),
    Option("--event E", "only solves with this event, e.g. NEAR_SINGULAR"),
    Option("--phase P", "only rows of this phase, e.g. hand-alignment"),
)
MAX_ROWS = Option("--most N", "maximum number of rows", 40)
FORMAT_OF_SUFFIX = {".mcap": "viewer", ".parquet": "parquet", ".csv": "csv"}
"""Format of `log export` by suffix of the output."""


@command(LOGS)
def info(args: Arguments) -> CommandResult:
    """Summarise logs: methods, solves, iterations, events, size and origin."""
    parts: list[RenderableType] = []
    for name in args.files:
        log = logs.open(name)
        summary = log.info()
        parts += [_title(name), fields(_container_fields(log, summary))]
        parts += [_method_table(log, summary), fields(_origin_fields(log))]
    return CommandResult(Group(*parts))


@command(LOGS, *FILTERS, MAX_ROWS)
def solves(args: Arguments) -> CommandResult:
    """List solves with their status."""
    selection = logs.open(args.files).solves(**_filters(args))
    parts: list[RenderableType] = []
    remaining = args.most
    for part in selection.parts:
        rows = part.first(remaining)
        remaining -= len(rows)
        if len(rows):
            parts.append(Text(f"  {part.method}", "bold"))
            records = logs.Table("solve", (rows,)).records()
            for shard, shard_records in groupby(records, lambda record: record.get("shard")):
                parts += [] if shard is None else [Text(f"  from {shard}", "dim")]
                parts.append(_solve_table(part, shard_records))
    return CommandResult(Group(*parts, _row_count(len(selection), args.most, "solve")))


@command(LOGS, *FILTERS, MAX_ROWS)
def events(args: Arguments) -> CommandResult:
    """List events: singularities, limits, stalls, ..."""
    selection = logs.open(args.files).events(**_filters(args))
    numbers = ("solve", "iteration")
    rows = table(*numbers, "method", "phase", "event", right=numbers)
    for part in selection.parts:
        part = part.first(args.most - len(rows.rows))
        for number, event in zip(part.solve_id.tolist(), events_of(part), strict=True):
            text = Text(describe(event), "yellow" if event.kind in SERIOUS else "")
            rows.add_row(str(number + 1), str(event.iteration + 1), part.method, event.phase, text)
    count = _row_count(len(selection), args.most, "event")
    return CommandResult(Group(_wrap_last_column(rows), count))


@command(LOG, *SINGLE_SOLVE)
def explain_solve(args: Arguments) -> CommandResult:
    """Explain one solve in words."""
    solve = _load_solve(args, logs.open(args.file))
    explanation = explain(solve)
    parts: list[RenderableType] = [headline(solve.success, solve.status, explanation.headline)]
    if solve.shard:
        parts.append(Text(f"  solve {solve.number + 1} of {solve.shard}"))
    for title, lines in explanation.parts.items():
        parts.append(Text(f"  {title}", "bold"))
        parts += [indented(line, width=4) for line in lines]
    return CommandResult(Group(*parts))


@command(
    LOG,
    *SINGLE_SOLVE,
    Option(
        "--out FILE.png",
        "output file (default: named after log, method and solve)",
        parse=opt.file_name(".png"),
    ),
    Option(
        "--range FIRST LAST",
        "first and last iteration to draw, from 1 (default: all)",
        parse=opt.word_list(opt.integer(1)),
    ),
)
def plot(args: Arguments) -> CommandResult:
    """Plot the convergence of one solve (needs 'casadi-ik[plots]')."""
    with located("log plot", (MissingExtraError,)):
        from casadi_ik.app.pictures import draw_convergence
    log = logs.open(args.file)
    solve = _load_solve(args, log)
    default_name = Path(f"{Path(args.file).stem}-{solve.method}-{solve.solve_id + 1}.png")
    file = args.out or default_name
    check_outputs({"--out": file}, inputs=[Path(args.file)])
    filters = {"method": solve.method, "solve": solve.solve_id}
    with located(f"{args.file}: solve {solve.solve_id + 1}"):
        draw_convergence(
            log.iterations(**filters),
            file,
            events=log.events(**filters),
            tolerance=min(solve.tolerances, key=lambda tolerance: tolerance.position),
            span=tuple(args.range) if args.range else None,
            title=f"{solve.method} · solve {solve.solve_id + 1} · {solve.iterations} iterations"
            f" · {solve.status}",
        )
    return CommandResult(Group(*files({"plot": file})))


@command(
    LOGS,
    Option("--solve N", "number of a solve of the first method, from 1", parse=opt.integer(1)),
    Option("--methods M M", "two methods; last on the line (default: the only two)"),
)
def compare(args: Arguments) -> CommandResult:
    """Compare two methods on the same targets: one target in detail, many by statistics."""
    open_logs = [logs.open(name) for name in args.files]
    first, second = _two_methods(open_logs, args.methods)
    pairs = match_targets(open_logs, first, second)
    if args.solve is not None:
        pairs = pairs.of_first(args.solve - 1)
    if len(pairs) == 0:
        number = "" if args.solve is None else f" of solve {args.solve}"
        files_text = ", ".join(args.files)
        raise InputError(f"{files_text}: {first} and {second}: no target{number} in common")
    if len(pairs) > 1:
        return CommandResult(_comparison_summary(pairs))
    ((first_outcome, second_outcome),) = pairs.pairs
    records = (
        one_solve(first_outcome.log, first_outcome.solve_id, first_outcome.method),
        one_solve(second_outcome.log, second_outcome.solve_id, second_outcome.method),
    )
    rows = table("", *(f"{record.method}, solve {record.solve_id + 1}" for record in records))
    for row in compare_solves(*records):
        rows.add_row(row.quantity, row.first, row.second)
    return CommandResult(rows)


@command(
    LOGS,
    opt.out_option("REPORT.html", "output file"),
    Option("--title TEXT", "title of the page (default: name of the log)"),
    Option("--most N", "maximum number of solves listed with details", 200),
)
def report(args: Arguments) -> CommandResult:
    """Write a study as a self-contained HTML page (needs 'casadi-ik[plots]').

    The page shows success, time and iterations by method and target set, failures by
    reason, a table of the hardest solves with details that can be filtered and
    sorted, and the positions of unsolved targets. Logs of the same robot are
    combined.
    """
    with located("log report", (MissingExtraError,)):
        from casadi_ik.app.pictures import study_page
    paths = [Path(name) for name in args.files]
    log = logs.open(paths)
    check_outputs({"--out": args.out}, inputs=paths)
    title = args.title or ", ".join(path.stem for path in paths)
    page = study_page(log, title, args.most)
    with output(args.out) as part:
        part.write_text(page, encoding="utf-8")
    count = count_text(sum(len(part) for part in log.solves().parts), "solve")
    return CommandResult(Group(Text(f"  {count}"), *files({"page": args.out})))


@command(
    LOG,
    *FILTERS,
    Option("--what iterations|solves|events", "rows of a table", "iterations"),
    Option(
        "--to viewer|parquet|csv",
        f"format (default: by suffix of --out: {', '.join(FORMAT_OF_SUFFIX)})",
    ),
    Option("--robot R", "robot of the viewer file (default: the log's)"),
    opt.out_option("FILE", "output file", opt.file_name()),
)
def export(args: Arguments) -> CommandResult:
    """Write tables, or a file for a viewer.

    VIEW.mcap is a file for Foxglove (app.foxglove.dev) and Lichtblick: one solve with
    the robot, its frames, joints, contacts, phases and events at 10 ms per iteration
    (needs 'casadi-ik[view]'). The file VIEW.layout.json next to it is a layout to
    import in the viewer.
    TABLE.parquet or TABLE.csv is a table (needs polars).
    """
    kind = args.to or FORMAT_OF_SUFFIX.get(args.out.suffix.lower())
    if kind is None:
        raise InputError(
            f"--out: found {str(args.out)!r}, expected a suffix {', '.join(FORMAT_OF_SUFFIX)}, or "
            "--to"
        )
    if kind == "viewer":
        return _export_view(args, args.out)
    check_outputs({"--out": args.out}, inputs=[Path(args.file)])
    log = logs.open(args.file)
    with located("log export", (MissingExtraError,)):
        frame = getattr(log, args.what)(**_filters(args)).frame()
    with output(args.out) as part:
        (frame.write_parquet if kind == "parquet" else frame.write_csv)(part)
    summary = {"rows": f"{frame.height} {args.what}", "columns": str(frame.width)}
    return CommandResult(Group(fields(summary), *files({kind: args.out})))


@command(LOGS)
def finish(args: Arguments) -> CommandResult:
    """Repair logs in place whose writer was killed.

    Files of a folder without a complete chunk are reported and not changed.
    """
    parts: list[RenderableType] = []
    paths = log_files(args.files)
    for path, _ in paths:
        try:
            result = finish_log(path)
        except NothingWrittenError:
            if len(paths) == 1:
                raise
            entries = {"result": f"not changed: {EMPTY}"}
        except ForeignLogError as error:
            if len(paths) == 1:
                raise
            entries = {"result": f"not changed: {str(error).removeprefix(f'{path}: ')}"}
        else:
            repair = (
                f"{_size(result.cut)} of an incomplete end removed"
                if result.cut
                else "summary added"
            )
            counts = (
                f"{count_text(result.chunks, 'chunk')}, {count_text(result.messages, 'message')}"
            )
            entries = {
                "result": f"repaired: {repair}" if result.changed else "already complete",
                "contents": counts,
            }
        parts += [_title(str(path)), fields(entries)]
    return CommandResult(Group(*parts))


@command(LOGS, opt.out_option("FILE.mcap", "output file"))
def merge(args: Arguments) -> CommandResult:
    """Merge the shards of a study without recompression."""
    check_outputs({"--out": args.out}, inputs=[path for path, _ in log_files(args.files)])
    result = merge_logs(args.files, args.out)
    entries = {
        "shards": str(result.shards),
        "solves": ", ".join(f"{count} of {name}" for name, count in result.solves.items())
        or "none",
        "messages": str(result.messages),
        "size": _size(result.size),
        "skipped": _item_list(result.left_out, EMPTY),
    }
    return CommandResult(Group(fields(entries), *files({"log": args.out})))


def _export_view(args: Arguments, file: Path) -> CommandResult:
    """Write a solve for a viewer, and the layout next to it."""
    with located("log export", (MissingExtraError,)):
        from casadi_ik.app.log_viewers import layout_of, write_view
    layout = file.with_suffix(".layout.json")
    check_outputs({"--out": file, "the layout": layout}, inputs=[Path(args.file)])
    log = logs.open(args.file)
    solve = _load_solve(args, log)
    robot = robot_of_log(log, args.file, args.robot or solve.robot)
    write_view(file, solve, robot)
    write_json(layout, layout_of(solve, robot))
    return CommandResult(Group(*files({"viewer": file, "layout": layout})))


def _load_solve(args: Arguments, log: logs.Log) -> SolveRecord:
    """Return the solve that the arguments select.

    Raises:
        LogError: The log is damaged.
        UnknownNameError: The log has no such solve, or several; the message names the file.
    """
    number = getattr(args, "number", None)
    try:
        number = args.solve if number is None else number
        return one_solve(log, number, args.method, counted_from=1)
    except UnknownNameError as error:
        prefix = "" if args.file in str(error) else f"{args.file}: "
        raise UnknownNameError(f"{prefix}{error}") from error


def _filters(args: Arguments) -> dict[str, Any]:
    """Return the filters of a command as keyword arguments of methods of `Log`."""
    filters = {option.name.strip("-"): getattr(args, option.attribute) for option in FILTERS}
    return filters if args.solve is None else {**filters, "solve": args.solve - 1}


def _title(name: str) -> Text:
    return Text(name, "bold", no_wrap=True, overflow="ignore")


def _wrap_last_column(rows: Table) -> Table:
    """Disable wrapping in all columns but the last."""
    for column in rows.columns[:-1]:
        column.no_wrap = True
    return rows


def _row_count(count: int, max_rows: int, noun: str) -> RenderableType:
    """Return the number of rows, and how to list more than `max_rows` of them."""
    if count <= max_rows:
        return Text(f"  {count_text(count, noun)}")
    return Text(f"  first {max_rows} of {count_text(count, noun)} (use --most to list more)")


def _item_list(items: Sequence[Any], reason: str = "") -> str:
    """Return the count of items, the first few, and the reason; "" without items."""
    if not items:
        return ""
    suffix = f" and {len(items) - MAX_ITEMS} more" if len(items) > MAX_ITEMS else ""
    count = f"{len(items)}: " if len(items) > 1 else ""
    text = f"{count}{', '.join(map(str, items[:MAX_ITEMS]))}{suffix}"
    return f"{text}: {reason}" if reason else text


def _size(count: int) -> str:
    """Format a number of bytes with a suitable unit."""
    for unit, scale in (("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.3g} {unit}"
    return f"{count} bytes"


def _solve_table(part: logs.MethodRows, records: Iterable[Mapping[str, Any]]) -> Table:
    """Return a table of solves of one method, with restarts if there are any."""
    restarts = ["restarts"] if part.rows["restarts"].any() else []
    numbers = ("iterations", *restarts, "pos [mm]", "ang [deg]", "time")
    rows = table("solve", "status", *numbers, "events", right=("solve", *numbers))
    for record in records:
        rows.add_row(
            str(record["solve_id"] + 1),
            Text(record["status"], "green" if record["success"] else "red"),
            str(record["iterations"]),
            *(str(record[name]) for name in restarts),
            _largest_error(record["position_error"], 1e3),
            _largest_error(record["angle_error"], math.degrees(1.0)),
            duration(record["time"]),
            _event_counts(part.labels["events"], record)
            + ("" if record["kept"] else " (totals only)"),
        )
    return _wrap_last_column(rows)


def _largest_error(values: Any, factor: float) -> str:
    """Return the largest error of all fingers; "free" if every contact is free."""
    finite = [value for value in np.ravel(values).tolist() if not math.isnan(value)]
    return f"{factor * max(finite):.2f}" if finite else "free"


def _event_counts(kinds: Sequence[str], record: Mapping[str, Any]) -> str:
    """Return the counts of events of a solve by kind, and its fixed actuators."""
    counts = zip(kinds, np.ravel(record["events"]).tolist(), strict=True)
    texts = [f"{count} {kind}" for kind, count in counts if count and kind not in ROUTINE_EVENTS]
    return ", ".join(texts + [f"{name} fixed" for name in record.get("fixed_mask", ())])


def _container_fields(log: logs.Log, summary: logs.LogInfo) -> dict[str, str]:
    """Return robot, sizes, attachments and incomplete files as text by name."""
    iterations = sum(counts["iteration"] for counts in summary.counts.values())
    per_iteration = f", {summary.size / iterations:.0f} bytes/iteration" if iterations else ""
    chunks = f"{summary.chunks}, compression {summary.compression}"
    if summary.compressed:
        chunks += f" (ratio {summary.uncompressed / summary.compressed:.1f})"
    attached = (f"{name} ({_size(length)})" for name, length in summary.attachments.items())
    sources = log.sources.names
    return {
        "robot": summary.robot,
        "shards": _item_list(sources) if len(sources) > 1 else "",
        "size": f"{_size(summary.size)}{per_iteration}",
        "chunks": chunks,
        "attachments": ", ".join(attached) or "none",
        "incomplete": _item_list(summary.unfinished, INCOMPLETE),
        "skipped": _item_list(summary.left_out, EMPTY),
    }


def _method_table(log: logs.Log, summary: logs.LogInfo) -> RenderableType:
    """Return counts, statuses and singular values by method, and the events below."""
    right = ("solves", "iterations")
    rows = table("method", *right, "status", "smallest sigma", right=right)
    events: dict[str, str] = {}
    for method, counts in summary.counts.items():
        solves = log.solves(method=method)
        numbers = str(counts["solve"]), str(counts["iteration"])
        status = "\n".join(_tally(solves, "status")) or "none"
        rows.add_row(method, *numbers, status, _smallest_sigma(solves))
        events[method] = ", ".join(_tally(log.events(method=method), "kind")) or "none"
    titles = {f"events of {name}" if len(events) > 1 else "events": name for name in events}
    return Group(rows, fields({title: events[name] for title, name in titles.items()}))


def _tally(selection: logs.Table, field: str) -> list[str]:
    """Return "COUNT NAME" for every value of a field, the most frequent first."""
    names = Counter(name for part in selection.parts for name in part.readable(field))
    return [f"{count} {name}" for name, count in names.most_common()]


def _smallest_sigma(solves: logs.Table) -> str:
    """Return the smallest singular value of every Jacobian, or "not measured"."""
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


def _origin_fields(log: logs.Log) -> dict[str, str]:
    """Return the metadata of a log as text by name, with the values of all its shards."""
    shards = [_metadata_texts(source.metadata) for source in log.sources.sources]
    pairs = {}
    for name in dict.fromkeys(name for shard in shards for name in shard):
        texts = list(dict.fromkeys(shard.get(name, "none") for shard in shards))
        suffix = f" | {len(texts) - MAX_ITEMS} more" if len(texts) > MAX_ITEMS else ""
        text = texts[0]
        if len(texts) > 1 and name != "created":
            text = f"{' | '.join(texts[:MAX_ITEMS])}{suffix} (by shard)"
        pairs[printable(name, 60)] = printable(text, 2000)
    return pairs


def _metadata_texts(metadata: Mapping[str, Any]) -> dict[str, str]:
    """Return the metadata of one shard as text by name."""
    packages = {"casadi_ik": metadata.get("code_version"), "python": metadata.get("python")}
    packages |= metadata.get("packages", {})
    parameters = metadata.get("parameters", {})
    texts = {
        "created": str(metadata.get("created")),
        "seed": str(metadata.get("seed")),
        "machine": _one_line(metadata.get("machine", {})),
        "versions": " ".join(f"{name} {value}" for name, value in packages.items()),
        **({} if "scene" in parameters else {"collision": "not checked"}),
    }
    for name, value in parameters.items():
        text = _tolerance_text(value) if name == "tolerance" else _one_line(value)
        if name == "options" and isinstance(value, Mapping):
            from casadi_ik.solve.registry import changed_options  # imports CasADi

            changed = changed_options(str(parameters.get("method")), value)
            text = _one_line(changed) if changed else "default"
        texts[name.replace("_", " ")] = text
    return texts


def _tolerance_text(value: Any) -> str:
    """Format tolerances by finger in mm and degrees, as one value if all fingers agree."""
    try:
        texts = {
            finger: " and ".join(
                (format_quantity(item["position"], "m"), format_quantity(item["angle"], "rad"))
            )
            for finger, item in value.items()
        }
    except (AttributeError, TypeError, KeyError, ValueError, OverflowError):
        return _one_line(value)  # metadata that another program has written
    distinct = set(texts.values())
    return distinct.pop() if len(distinct) == 1 else _one_line(texts)


def _one_line(value: Any) -> str:
    """Format JSON data on one line, and a mapping as "name value, ..."."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_one_line(item)}" for key, item in value.items()) or "none"
    if isinstance(value, float):
        return f"{value:.6g}"
    return value if isinstance(value, str) else json.dumps(value)


def _two_methods(open_logs: list[logs.Log], names: list[str] | None) -> tuple[str, str]:
    """Return the two methods of ``--methods``, or else the only two methods of the logs.

    Raises:
        InputError: A method is not in the logs, or the logs hold another number of methods.
    """
    available = list(dict.fromkeys(method for log in open_logs for method in log.methods))
    for method in names or ():
        if method not in available:
            raise InputError(f"--methods: found {method!r}, expected one of {', '.join(available)}")
    pair = names or available
    if len(pair) != 2:
        raise InputError(
            "--methods: option is missing; expected two methods of those in the logs: "
            f"{', '.join(available) or 'none'}"
        )
    return pair[0], pair[1]


def _comparison_summary(pairs: MatchedTargets) -> RenderableType:
    """Return success, mean iterations and mean time of two methods on the same targets."""
    outcomes = pairs.pairs
    success = np.array([[outcome.success for outcome in pair] for pair in outcomes])
    iterations = np.array([[outcome.iterations for outcome in pair] for pair in outcomes])
    times = np.array([[outcome.time for outcome in pair] for pair in outcomes])
    columns = ("method", "solved", "mean iterations", "mean time")
    rows = table(*columns, right=("solved",))
    by_both = success.all(axis=1)
    lines = ["means are over the targets that both methods solve"]
    lines.append(f"solved by both {by_both.sum()}, by neither {(~success.any(axis=1)).sum()}")
    for i, name in enumerate((pairs.first, pairs.second)):
        means = ("-", "-")
        if by_both.any():
            mean_time = 1e3 * times[by_both, i].mean()
            means = (f"{iterations[by_both, i].mean():.1f}", f"{mean_time:.3g} ms")
        rows.add_row(name, f"{success[:, i].sum()} of {len(success)}", *means)
        only = np.flatnonzero(success[:, i] & ~success[:, 1 - i]).tolist()
        numbers = _item_list([outcomes[j][0].solve_id + 1 for j in only]).partition(": ")
        suffix = f" (solve {numbers[2] or numbers[0]})" if only else ""
        lines.append(f"only by {name}: {len(only)}{suffix}")
    return Group(rows, *(Text(f"  {line}") for line in lines))
