"""Several results of `bson evaluate` beside each other: a table, compare.json and compare.html, with paired differences.

Episodes are paired by cell and seed: there the robots met the same people on the same map.
"""

import html
import json
import math

from bson import heatmap
from bson.heatmap import Scale, Tile, cell_maps
from bson.metrics import GROUPS, METRICS, summarise
from bson.page import numbers, page, plural
from macid.documents import shown

MAIN = (
    "SNS", "success", "RC", "Coll", "SP", "PE", "SPL", "Coll_person", "time", "nearest_person", "personal_space",
    "time_to_collision",
)  # fmt: skip
BY_CELL = ("SNS", "success", "Coll")
LEAST_PAIRS = 6  # with fewer, differences that all have one sign come by chance in more than 5%


def check_comparable(runs):
    """Raises ValueError, naming the difference, unless all `runs` (bson.results.Results) are of one suite in one version and setting."""
    first = runs[0]
    for run in runs[1:]:
        for key, what in (("suite", "suite"), ("overrides", "--set"), ("suite_digest", "digest of the suite")):
            ours, theirs = (each.content.get(key) for each in (first, run))
            if ours != theirs:
                raise ValueError(
                    f"Can't compare '{first.source}' and '{run.source}': {what} {_setting(ours)} against {_setting(theirs)}."
                )
        for cell, config in first.configs.items():
            for field, value in run.configs.get(cell, config).items():
                if config.get(field) != value:
                    raise ValueError(
                        f"Can't compare '{first.source}' and '{run.source}': {field} is {shown(config.get(field))} "
                        f"against {shown(value)} in cell '{cell}'."
                    )
        ours, theirs = (each.content.get("task_digest") for each in (first, run))
        if ours and theirs and ours != theirs:
            raise ValueError(
                f"Can't compare '{first.source}' and '{run.source}': a map, a robot or the pedestrians' weights changed in "
                "between, under the same name. Evaluate again."
            )


def _setting(value):
    if isinstance(value, dict):
        return ", ".join(f"{key}={each}" for key, each in value.items()) or "nothing"
    return "none" if value is None else shown(value)


def labels(runs):
    """A name for each run: its agent, with the source where the agent alone doesn't tell them apart."""
    agents = [run.content["agent"] for run in runs]
    return [
        agent if agents.count(agent) == 1 else f"{agent} ({run.source})"
        for agent, run in zip(agents, runs, strict=True)
    ]


def _shared(runs):
    """(cell, seed) of the episodes that all runs have, in the first one's order. Raises ValueError if there is none."""
    rows = [run.rows for run in runs]
    shared = [key for key in rows[0] if all(key in others for others in rows)]
    if not shared:
        seeds = [[row["seed"] for row in run.content["episodes"]] for run in runs]
        told = ", ".join(
            f"'{run.source}' has the seeds {min(each)} to {max(each)}" if each else f"'{run.source}' has none"
            for run, each in zip(runs, seeds, strict=True)
        )
        raise ValueError(f"No episode in common: {told}. Evaluate with the same --seed.")
    return shared


def _measured(run, keys, names):
    """Metrics `names` of the episodes `keys`, as `measure` gives them."""
    rows = run.rows
    return [{name: math.inf if rows[key][name] is None else rows[key][name] for name in names} for key in keys]


def differences(measured, reference):
    """Mean paired differences `measured` - `reference`, dicts of `measure` of the same episodes, with 95% intervals.

    {metric: {"mean", "low", "high", "count", "differs"}}. count: pairs in which both are finite; differs: whether the
    interval excludes 0, and comes of at least LEAST_PAIRS pairs.
    """
    pairs = zip(measured, reference, strict=True)
    found = summarise([{name: ours[name] - theirs[name] for name in ours} for ours, theirs in pairs])
    for row in found.values():
        row["differs"] = row["count"] >= LEAST_PAIRS and (row["low"] > 0 or row["high"] < 0)
    return found


def _side_by_side(runs, keys, names):
    """For each run the summary over the episodes `keys`, and its differences from the first; None for the first."""
    measured = [_measured(run, keys, names) for run in runs]
    return [
        {"summary": summarise(rows), "difference": differences(rows, measured[0]) if place else None}
        for place, rows in enumerate(measured)
    ]


def _notes(runs, names, keys):
    """What a reader must know."""
    notes = []
    if any(len(run.rows) > len(keys) for run in runs):
        had = ", ".join(f"{name} has {len(run.rows)}" for name, run in zip(names, runs, strict=True))
        notes.append(f"Only the {plural(len(keys), 'episode')} that all runs have are compared: {had}.")
    for name, run in zip(names, runs, strict=True):
        if faults := run.content.get("faults"):
            notes.append(
                f"{name}: {plural(len(faults), 'episode')} ended in a fault of the simulation and is not scored."
            )
    for package, version in runs[0].content["versions"].items():
        found = dict.fromkeys(run.content["versions"].get(package) for run in runs)
        if len(found) > 1:
            notes.append(f"Made with different versions of {package}: {', '.join(map(str, found))}.")
    return notes


def compare(runs):
    """The content of compare.json: each run's summary over the episodes that all have, and differences from the first.

    Raises ValueError where the runs are of different suites, versions of a suite or settings, or share no episode.
    """
    if len(runs) < 2:
        raise ValueError("Name at least two results to compare.")
    check_comparable(runs)
    keys, names, first = _shared(runs), labels(runs), runs[0].content
    metrics = [m.name for m in METRICS if all(m.name in row for run in runs for row in run.content["episodes"])]
    cells = []
    for cell in first["cells"] if len(first["cells"]) > 1 else ():
        if within := [key for key in keys if key[0] == cell["name"]]:
            cells.append(
                {
                    "name": cell["name"],
                    "grades": cell["grades"],
                    "episodes": len(within),
                    "runs": _side_by_side(runs, within, [name for name in metrics if name in BY_CELL]),
                }
            )
    return {
        "suite": first["suite"],
        "suite_digest": first.get("suite_digest"),
        "overrides": first.get("overrides", {}),
        "config": first["cells"][0]["config"],
        "episodes": len(keys),
        "notes": _notes(runs, names, keys),
        "runs": [
            {
                "name": name,
                "source": run.source,
                **{key: run.content.get(key) for key in ("agent", "track", "command", "versions")},
                **side,
            }
            for name, run, side in zip(names, runs, _side_by_side(runs, keys, metrics), strict=True)
        ],
        "cells": cells,
    }


def _text(row, signed=False):
    """A row of `summarise` or `differences`: mean and interval, and a star where it differs."""
    if row is None:
        return "-"
    star = " *" if row.get("differs") else ""
    mean, low, high = numbers(row["mean"], row["low"], row["high"], signed=signed)
    return f"{mean} [{low}, {high}]{star}"


def _aligned(lines):
    """Rows of words as text in columns."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return ["  ".join(word.ljust(w) for word, w in zip(line, widths, strict=True)).rstrip() for line in lines]


def format_comparison(content):
    """`content` of compare.json as plain text: the main metrics, their differences, and the SNS cell by cell."""
    runs = content["runs"]
    first, others = runs[0]["name"], runs[1:]
    metrics = [name for name in MAIN if any(name in run["summary"] for run in runs)]
    names = [run["name"] for run in runs]
    lines = [f"{content['suite']}: {plural(content['episodes'], 'episode')} of each run (mean, 95% interval)"]
    lines += _aligned(
        [["metric", *names], *([name, *(_text(run["summary"].get(name)) for run in runs)] for name in metrics)]
    )
    lines += [
        "",
        f"Difference from {first}, paired by episode (* where the interval excludes 0, of {LEAST_PAIRS} pairs or more)",
    ]
    lines += _aligned(
        [
            ["metric", *(run["name"] for run in others)],
            *([name, *(_text(run["difference"].get(name), True) for run in others)] for name in metrics),
        ]
    )
    if content["cells"]:
        lines += ["", f"SNS by cell, and its difference from {first}'s"]
        table = [["cell", "episodes", *names, *(f"{run['name']} - {first}" for run in others)]]
        for cell in content["cells"]:
            values = [_text(side["summary"].get("SNS")) for side in cell["runs"]]
            values += [_text(side["difference"].get("SNS"), True) for side in cell["runs"][1:]]
            table.append([cell["name"], str(cell["episodes"]), *values])
        lines += _aligned(table)
    return "\n".join([*lines, "", *content["notes"]]).rstrip()


_STYLE = """
.plain:has(.runs){width:fit-content;max-width:100%} .runs{font-size:14px} .runs td,.runs th{vertical-align:top;padding:4px 14px}
.runs td>span{display:block;white-space:nowrap}
.runs td:first-child,.runs th:first-child{position:sticky;left:0} .runs th:first-child{z-index:2}
.runs tr:nth-child(odd) td:first-child{background:#fff} .runs tr.group td:first-child{background:#f4f6f8;color:#5b6876}
.runs tr.group td:first-child{font-weight:600;text-align:left;padding-top:10px}
@media(max-width:640px){.runs{font-size:13px} .runs td,.runs th{padding:4px 8px} .runs td.left small{display:block}}
.difference{font-size:13px;color:#5b6876} .better{color:#166c8c;font-weight:600} .worse{color:#bc4a30;font-weight:600}
"""


def _judged(row, better):
    """A row of `differences` as HTML: teal where it differs for the better, red for the worse."""
    if row is None:
        return '<span class="difference">&ndash;</span>'
    kind = ""
    if row["differs"] and better:
        kind = " better" if (row["mean"] > 0) == (better == "up") else " worse"
    return f'<span class="difference{kind}">{_text(row, True)}</span>'


def _value(row):
    if row is None:
        return "<span>&ndash;</span>"
    mean, low, high = numbers(row["mean"], row["low"], row["high"])
    return f"<span><b>{mean}</b> <small>[{low}, {high}]</small></span>"


def _metric_table(content):
    """Every metric but the minor ones, a column a run; below each mean its difference from the first run's."""
    runs = content["runs"]
    arrow = {"up": "&uarr;", "down": "&darr;", "": ""}
    lines = []
    shown = [m for m in METRICS if not m.minor and any(m.name in run["summary"] for run in runs)]
    for group in (group for group in GROUPS if any(metric.group == group for metric in shown)):
        lines.append(f'<tr class="group"><td colspan="{len(runs) + 1}">{group.capitalize()}</td></tr>')
        for metric in (metric for metric in shown if metric.group == group):
            values = []
            for run in runs:
                difference = (
                    "" if run["difference"] is None else _judged(run["difference"].get(metric.name), metric.better)
                )
                values.append(f"<td>{_value(run['summary'].get(metric.name))}{difference}</td>")
            unit = f"<small>{metric.unit} {arrow[metric.better]}</small>"
            lines.append(
                f'<tr><td class="left" title="{html.escape(metric.what)}">{metric.name} {unit}</td>{"".join(values)}</tr>'
            )
    head = "".join(f"<th>{html.escape(run['name'])}</th>" for run in runs)
    return f'<div class="plain"><table class="runs"><tr><th class="left">metric</th>{head}</tr>{"".join(lines)}</table></div>'


def _tile(grades, row):
    if row is None:
        return Tile(grades, None)
    return Tile(grades, row["mean"], row["low"], row["high"], " *" if row.get("differs") else "")


def _overview(runs):
    """SNS, success and collisions of the runs as dot plots."""
    most = max([10.0, *(run["summary"]["Coll"]["high"] for run in runs if "Coll" in run["summary"])])
    shown = (
        ("SNS", Scale(0.0, 100.0), "SNS", "of 100, more is better", 1),
        ("success", Scale(0.0, 1.0), "Success", "share that reached the goal", 2),
        ("Coll", Scale(0.0, most, "down", True), "Collision steps", "of 0.02 s; less is better", None),
    )
    maps = (
        cell_maps([_tile({"run": run["name"]}, run["summary"].get(name)) for run in runs], scale, heading, note, digits)
        for name, scale, heading, note, digits in shown
    )
    return f'<div class="dotplots">{"".join(maps)}</div>'


def _sns_maps(content):
    """The SNS over the suite's cells: of each run, then of the differences from the first."""
    names, cells = [run["name"] for run in content["runs"]], content["cells"]
    maps = []
    for place, name in enumerate(names):
        tiles = [_tile(cell["grades"], cell["runs"][place]["summary"].get("SNS")) for cell in cells]
        maps.append(cell_maps(tiles, Scale(0.0, 100.0), name, "SNS", 1))
    rows = [side["difference"].get("SNS") for cell in cells for side in cell["runs"][1:]]
    most = max([1.0, *(abs(row["mean"]) for row in rows if row)])
    for place, name in enumerate(names[1:], start=1):
        tiles = [_tile(cell["grades"], cell["runs"][place]["difference"].get("SNS")) for cell in cells]
        heading = f"{name} less {names[0]}"
        maps.append(cell_maps(tiles, Scale(-most, most), heading, "paired difference of the SNS", 1))
    kind = "dotplots" if len(cells[0]["grades"]) == 1 else "films"
    return f'<div class="{kind}">{"".join(maps)}</div>'


def _cell_table(content):
    """Success and collisions beside the SNS, cell by cell."""
    names = [run["name"] for run in content["runs"]]
    better = {metric.name: metric.better for metric in METRICS}
    head = "".join(f"<th>{html.escape(name)}<br><small>{metric}</small></th>" for metric in BY_CELL for name in names)
    lines = []
    for cell in content["cells"]:
        values = [
            f"<td>{_value(side['summary'].get(metric))}"
            + ("" if side["difference"] is None else _judged(side["difference"].get(metric), better[metric]))
            + "</td>"
            for metric in BY_CELL
            for side in cell["runs"]
        ]
        lines.append(f'<tr><td class="left">{html.escape(cell["name"])}</td>{"".join(values)}</tr>')
    return (
        '<details><summary>All cells in figures</summary><div class="plain"><table class="runs">'
        f'<tr><th class="left">cell</th>{head}</tr>{"".join(lines)}</table></div></details>'
    )


def _made_with(content):
    commands = "".join(
        f'<p class="sub">{html.escape(run["name"])}: <code>{html.escape(run["command"] or run["source"])}</code></p>'
        for run in content["runs"]
    )
    what = "of the first cell" if content["cells"] else "of the episodes"
    folded = {
        f"Configuration {what}": content["config"],
        "Versions": {run["name"]: run["versions"] for run in content["runs"]},
    }
    return commands + "".join(
        f"<details><summary>{name}</summary><pre>{html.escape(json.dumps(value, indent=1))}</pre></details>"
        for name, value in folded.items()
    )


def make_page(content):
    """compare.html as text, of the `content` of compare.json."""
    runs = content["runs"]
    first = html.escape(runs[0]["name"])
    title = f"{', '.join(run['name'] for run in runs)} on {content['suite']}"
    digest = f" (digest <code>{content['suite_digest']}</code>)" if content["suite_digest"] else ""
    changed = f", changed: {html.escape(_setting(content['overrides']))}" if content["overrides"] else ""
    cells = f" in {plural(len(content['cells']), 'cell')}" if content["cells"] else ""
    notes = "".join(f'<p class="note">{html.escape(note)}</p>' for note in content["notes"])
    strata = f"<h2>SNS by cell</h2>{_sns_maps(content)}{_cell_table(content)}" if content["cells"] else ""
    body = f"""<h1>{html.escape(title)}</h1>
<p class="sub">BSON suite <b>{html.escape(content["suite"])}</b>{digest}{changed}; {plural(content["episodes"], "episode")}
of each run{cells}; means with bootstrap 95% intervals.</p>
{notes}{_overview(runs)}
<h2>Metrics</h2><p class="sub">Below a mean: its difference from {first}'s, over pairs of episodes with the same cell and seed.
<span class="better">Better *</span> and <span class="worse">worse *</span>: the interval excludes 0, and comes of at least
{LEAST_PAIRS} pairs. Infinite values don't enter.</p>{_metric_table(content)}
{strata}
<h2>Made with</h2>{_made_with(content)}"""
    return page(title, body, heatmap.STYLE + _STYLE)
