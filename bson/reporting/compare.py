"""Several results of `bson evaluate` beside each other, with paired differences: a table, compare.json, compare.html.

Episodes are paired by cell and seed: in such a pair the robots met the same people on the same map. Several trainings
of one agent are one column (Group): bson.evaluation.statistics says what their intervals are over.
"""

import dataclasses
import itertools
import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from bson.evaluation.metrics import GROUPS, METRICS, TAKEN, metrics_of
from bson.evaluation.results import Results
from bson.evaluation.statistics import (
    LEAST_SEEDS,
    difference_of_runs,
    improvement,
    interquartile_mean,
    pairs_of,
    summarise_runs,
    table,
)
from bson.reporting.heatmap import Scale, Tile, cell_maps
from bson.reporting.page import BETTER, DASH, numbers, plural, render
from macid.documents import shown

MAIN = (
    "SNS", "success", "RC", "Coll", "SP", "PE", "SPL", "Coll_person", "time", "nearest_person", "personal_space",
    "time_to_collision",
)  # fmt: skip
BY_CELL = ("SNS", "success", "Coll")
JUDGED = ("SNS", "Coll")  # metrics with interquartile means, and with the probability of improvement
LEAST_PAIRS = 6  # with fewer pairs, differences that all have one sign come by chance in more than 5% of cases


@dataclasses.dataclass(frozen=True)
class Group:
    """A column of the comparison: the Results of an agent, of each of its trainings where it was trained several
    times. name: the column's; "": the agent's."""

    runs: tuple[Results, ...]
    name: str = ""

    @property
    def source(self) -> str:
        """Where the results come from, as the user named it."""
        return ", ".join(run.source for run in self.runs)


def check_comparable(runs: Sequence[Results]) -> None:
    """Raises ValueError, naming the difference, unless all `runs` have the same suite, in the same version and setting.

    runs: bson.evaluation.results.Results.
    """
    first = runs[0]
    for run in runs[1:]:
        for key, what in (("suite", "suite"), ("overrides", "--set"), ("suite_digest", "digest of the suite")):
            ours, theirs = (each.content.get(key) for each in (first, run))
            if ours != theirs:
                raise ValueError(
                    f"Can't compare '{first.source}' and '{run.source}': {what} {_setting(ours)} against "
                    f"{_setting(theirs)}."
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
                f"Can't compare '{first.source}' and '{run.source}': a map, a robot or the pedestrians' weights "
                "changed in between, under the same name. Evaluate again."
            )


def check_different(runs: Sequence[Results]) -> None:
    """Raises ValueError where two of `runs` are the same: one agent's, with equal episodes."""
    for first, second in itertools.combinations(runs, 2):
        if first.agent == second.agent and first.content["episodes"] == second.content["episodes"]:
            raise ValueError(f"'{first.source}' and '{second.source}' are the same results: name them once.")


def _setting(value):
    if isinstance(value, dict):
        return ", ".join(f"{key}={each}" for key, each in value.items()) or "nothing"
    return "none" if value is None else shown(value)


def labels(groups: Sequence[Group]) -> list[str]:
    """A name for each group: its own, or its agent, with the source where two groups have the same name."""
    names = [group.name or group.runs[0].agent for group in groups]
    return [
        name if names.count(name) == 1 else f"{name} ({group.source})"
        for name, group in zip(names, groups, strict=True)
    ]


def _shared(runs):
    """(cell, seed) of the episodes that all runs have, in the first run's order. Raises ValueError if there is no such
    episode."""
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


def _measured(group, keys, names):
    """Metrics `names` of the episodes `keys`, as `measure` gives them, of each run of a group."""
    return [
        [{name: math.inf if rows[key][name] is None else rows[key][name] for name in names} for key in keys]
        for rows in (run.rows for run in group.runs)
    ]


def differences(measured: list[dict[str, float]], reference: list[dict[str, float]]) -> dict[str, Any]:
    """Mean paired differences `measured` - `reference`, dicts of `measure` of the same episodes, with 95% intervals.

    {metric: {"mean", "low", "high", "count", "differs"}}. count: pairs in which both are finite; differs: whether the
    interval excludes 0, and there are at least LEAST_PAIRS pairs.
    """
    return _differences([measured], [reference])


def _differences(measured, reference, seeds=None):
    """As `differences`, of the rows of several runs each; seeds: those of the episodes. Pairs of one seed are one."""
    found = difference_of_runs(measured, reference, seeds)
    enough = seeds is None or _told_apart(seeds)
    for row in found.values():
        row["differs"] = enough and row["count"] >= LEAST_PAIRS and (row["low"] > 0 or row["high"] < 0)
    return found


def _told_apart(seeds):
    """Whether the episodes with these `seeds` are of so many that a difference may be told."""
    return len(np.unique(seeds)) >= LEAST_PAIRS


def _seeds(keys):
    """(episodes,) the seeds of the episodes `keys`."""
    return np.array([seed for _, seed in keys])


def _side_by_side(groups, keys, names):
    """For each group the summary over the episodes `keys`, and its differences from the first group; None for the
    first."""
    measured, seeds = [_measured(group, keys, names) for group in groups], _seeds(keys)
    return [
        {
            "summary": summarise_runs(rows, seeds),
            "difference": _differences(rows, measured[0], seeds) if place else None,
        }
        for place, rows in enumerate(measured)
    ]


def _judged(groups, keys, metrics):
    """(for each group {metric: its interquartile mean}, the pairs of groups with the probability of improvement) of the
    `metrics` that all episodes `keys` have. Which of a pair is named first does not matter: the other has the rest."""
    better, seeds = {metric.name: metric.better for metric in METRICS}, _seeds(keys)
    cells = np.array([cell for cell, _ in keys])
    measured = [_measured(group, keys, metrics) for group in groups]
    values = {name: [table(rows, name) for rows in measured] for name in metrics}
    whole = {name: each for name, each in values.items() if all(math.isfinite(one.sum()) for one in each)}
    means = [
        {name: interquartile_mean(each[place], seeds)._asdict() for name, each in whole.items()}
        for place in range(len(groups))
    ]
    pairs = []
    for of, over in pairs_of(len(groups)):
        row: dict[str, Any] = {"of": of, "over": over}
        for name, each in whole.items():
            found = improvement(each[of], each[over], cells, better[name], seeds)
            row[name] = {
                "paired": found.paired._asdict() | {"ties": found.paired_ties},
                "unpaired": found.unpaired._asdict() | {"ties": found.unpaired_ties},
                "differs": _told_apart(seeds) and not found.paired.low <= 0.5 <= found.paired.high,
            }
        pairs.append(row)
    return means, pairs


def _notes(groups, keys):
    """Warnings that a reader must know."""
    notes, runs = [], [run for group in groups for run in group.runs]
    names = labels([Group((run,)) for run in runs])
    for name, group in zip(labels(groups), groups, strict=True):
        if 1 < len(group.runs) < LEAST_SEEDS:
            notes.append(f"{name}: {len(group.runs)} training seeds: intervals over so few are too narrow.")
        if len(agents := dict.fromkeys(run.agent for run in group.runs)) > 1:
            notes.append(f"{name} takes these agents for trainings of one: {', '.join(agents)}.")
    if any(len(run.rows) > len(keys) for run in runs):
        had = ", ".join(f"{name} has {len(run.rows)}" for name, run in zip(names, runs, strict=True))
        notes.append(f"Only the {plural(len(keys), 'episode')} that all runs have are compared: {had}.")
    for name, run in zip(names, runs, strict=True):
        if faults := run.content.get("faults"):
            notes.append(
                f"{name}: {plural(len(faults), 'episode')} ended in a fault of the simulation and is not scored."
            )
    for package in runs[0].content["versions"]:
        found = dict.fromkeys(run.content["versions"].get(package) for run in runs)
        if len(found) > 1:
            notes.append(f"Made with different versions of {package}: {', '.join(map(str, found))}.")
    if (seeds := len(set(_seeds(keys)))) < len(keys):
        notes.append(
            f"The {plural(len(keys), 'episode')} have {plural(seeds, 'seed')}; those of one seed share draws, such as "
            "the maze and the start. So intervals draw seeds, each with all of its episodes."
        )
    return notes


def compare(columns: Sequence[Results | Group]) -> dict[str, Any]:
    """The content of compare.json: each column's summary over the episodes that all runs have, and its differences from
    the first column; interquartile means, and of each pair of columns the probability that one does better.

    columns: Results, or Groups of them, in which the runs differ by their training seeds alone. Raises ValueError where
    the runs are of different suites, versions of a suite or settings, or share no episode, or where a group has a run
    twice.
    """
    if len(columns) < 2:
        raise ValueError("Name at least two results to compare.")
    groups = [each if isinstance(each, Group) else Group((each,)) for each in columns]
    runs = [run for group in groups for run in group.runs]
    check_comparable(runs)
    for group in groups:
        check_different(group.runs)
    keys, names, first = _shared(runs), labels(groups), runs[0].content
    metrics = [
        m.name for m in metrics_of(first) if all(m.name in row for run in runs for row in run.content["episodes"])
    ]
    cells = []
    for cell in first["cells"] if len(first["cells"]) > 1 else ():
        if within := [key for key in keys if key[0] == cell["name"]]:
            cells.append(
                {
                    "name": cell["name"],
                    "grades": cell["grades"],
                    "episodes": len(within),
                    "runs": _side_by_side(groups, within, [name for name in metrics if name in BY_CELL]),
                }
            )
    means, pairs = _judged(groups, keys, [name for name in JUDGED if name in metrics])
    own = {name: told for name, told in first.get("metrics", {}).items() if name in metrics and name not in TAKEN}
    return {
        "suite": first["suite"],
        "suite_digest": first.get("suite_digest"),
        "overrides": first.get("overrides", {}),
        "config": first["cells"][0]["config"],
        "episodes": len(keys),
        "notes": _notes(groups, keys),
        "runs": [
            {
                "name": name,
                "source": group.source,
                "training_seeds": len(group.runs),
                **{key: group.runs[0].content.get(key) for key in ("agent", "track", "command", "versions")},
                **side,
                "interquartile_mean": mean,
            }
            for name, group, side, mean in zip(names, groups, _side_by_side(groups, keys, metrics), means, strict=True)
        ],
        "improvement": pairs,
        "cells": cells,
        **({"metrics": own} if own else {}),  # units and meanings of the user's own metrics
    }


def _text(row, signed=False):
    """A row of `summarise` or `differences`: mean and interval as text, with a star where it differs."""
    if row is None:
        return "-"
    star = " *" if row.get("differs") else ""
    mean, low, high = numbers(row["mean"], row["low"], row["high"], signed=signed)
    return f"{mean} [{low}, {high}]{star}"


def _aligned(lines):
    """Rows of words as text in columns."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return ["  ".join(word.ljust(w) for word, w in zip(line, widths, strict=True)).rstrip() for line in lines]


def format_comparison(content: dict[str, Any]) -> str:
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
    lines += ["", *_judged_lines(content)]
    if content["cells"]:
        lines += ["", f"SNS by cell, and its difference from {first}'s"]
        table = [["cell", "episodes", *names, *(f"{run['name']} - {first}" for run in others)]]
        for cell in content["cells"]:
            values = [_text(side["summary"].get("SNS")) for side in cell["runs"]]
            values += [_text(side["difference"].get("SNS"), True) for side in cell["runs"][1:]]
            table.append([cell["name"], str(cell["episodes"]), *values])
        lines += _aligned(table)
    return "\n".join([*lines, "", *content["notes"]]).rstrip()


def _judged_lines(content):
    """Interquartile means and probabilities of improvement as lines of text."""
    runs, pairs = content["runs"], content["improvement"]
    metrics = list(runs[0]["interquartile_mean"])
    lines = ["Interquartile mean: of the middle half of the episodes of all of a column's trainings"]
    lines += _aligned(
        [
            ["metric", *(run["name"] for run in runs)],
            *([name, *(_estimate(run["interquartile_mean"][name]) for run in runs)] for name in metrics),
        ]
    )
    lines += ["", "Probability that one does better than another, a tie counted half, on the same episode (* where the"]
    lines.append("interval excludes 0.5), and on any two episodes of the same cell")
    table = [["", *(f"{name}{way}" for name in metrics for way in (", same episode", ", any two"))]]
    for pair in pairs:
        words = [f"{runs[pair['of']]['name']} over {runs[pair['over']]['name']}"]
        for name in metrics:
            words += [_chance(pair[name], "paired"), _chance(pair[name], "unpaired")]
        table.append(words)
    return lines + _aligned(table)


def _estimate(row):
    value, low, high = numbers(row["value"], row["low"], row["high"])
    return f"{value} [{low}, {high}]"


def _chance(row, way):
    """A probability of improvement as text, with a star where it bears out an order."""
    found = row[way]
    star = " *" if row["differs"] and way == "paired" else ""
    ties = f", {found['ties']:.0%} ties" if found["ties"] >= 0.005 else ""
    return f"{found['value']:.2f} [{found['low']:.2f}, {found['high']:.2f}]{ties}{star}"


def _side(side, metric, better):
    """The page's text for `metric` of one run, whose `side` is from `_side_by_side`: the mean with its interval, and
    the difference from the first run, with the CSS class of a better or worse one."""
    row, compared = side["summary"].get(metric), side["difference"] is not None
    shown = {"value": None if row is None else numbers(row["mean"], row["low"], row["high"]), "compared": compared}
    if compared:
        difference, kind = side["difference"].get(metric), ""
        if difference is not None and difference["differs"] and better:
            kind = " better" if (difference["mean"] > 0) == (better == "up") else " worse"
        shown |= {"difference": DASH if difference is None else _text(difference, True), "kind": kind}
    return shown


def _groups(runs, metrics):
    """{group: rows (metric, its arrow, the text for each run)} of every metric but the minor ones."""
    shown = [m for m in metrics if not m.minor and any(m.name in run["summary"] for run in runs)]
    return {
        group: [
            (metric, BETTER[metric.better], [_side(run, metric.name, metric.better) for run in runs])
            for metric in shown
            if metric.group == group
        ]
        for group in GROUPS
        if any(metric.group == group for metric in shown)
    }


def _tile(grades, row):
    if row is None:
        return Tile(grades, None)
    return Tile(grades, row["mean"], row["low"], row["high"], " *" if row.get("differs") else "")


def _overview(runs):
    """SNS, success and collisions of the runs as dot plots, each as HTML."""
    most = max([10.0, *(run["summary"]["Coll"]["high"] for run in runs if "Coll" in run["summary"])])
    shown = (
        ("SNS", Scale(0.0, 100.0), "SNS", "of 100, more is better", 1),
        ("success", Scale(0.0, 1.0), "Success", "share that reached the goal", 2),
        ("Coll", Scale(0.0, most, "down", True), "Collision steps", "of 0.02 s; less is better", None),
    )
    return [
        cell_maps([_tile({"run": run["name"]}, run["summary"].get(name)) for run in runs], scale, heading, note, digits)
        for name, scale, heading, note, digits in shown
    ]


def _sns_maps(content):
    """The SNS over the suite's cells: one map for each run, then one for each difference from the first run; each as
    HTML."""
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
    return maps


def _cells(content):
    """Rows (cell, the text for each run): success and collisions beside the SNS."""
    better = {metric.name: metric.better for metric in METRICS}
    return [
        (cell["name"], [_side(side, metric, better[metric]) for metric in BY_CELL for side in cell["runs"]])
        for cell in content["cells"]
    ]


def _judged_tables(content):
    """The page's tables (metrics, rows of interquartile means, rows of probabilities of improvement), each row (name,
    texts), with the CSS class of a pair whose order is borne out."""
    runs, metrics = content["runs"], list(content["runs"][0]["interquartile_mean"])
    means = [
        (run["name"], run["training_seeds"], [_estimate(run["interquartile_mean"][name]) for name in metrics])
        for run in runs
    ]
    pairs = [
        (
            f"{runs[pair['of']]['name']} over {runs[pair['over']]['name']}",
            [(_chance(pair[name], way), _kind(pair[name], way)) for name in metrics for way in ("paired", "unpaired")],
        )
        for pair in content["improvement"]
    ]
    return {"metrics": metrics, "means": means, "pairs": pairs}


def _kind(row, way):
    if way != "paired" or not row["differs"]:
        return ""
    return "better" if row[way]["value"] > 0.5 else "worse"


def make_page(content: dict[str, Any]) -> str:
    """The page compare.html as text. content: the content of compare.json."""
    runs, cells = content["runs"], content["cells"]
    documents = {
        f"Configuration {'of the first cell' if cells else 'of the episodes'}": content["config"],
        "Versions": {run["name"]: run["versions"] for run in runs},
    }
    strata = {"axes": len(cells[0]["grades"]), "maps": _sns_maps(content)} if cells else {}
    return render(
        "compare.html",
        title=f"{', '.join(run['name'] for run in runs)} on {content['suite']}",
        suite=content["suite"],
        digest=content["suite_digest"],
        changed=_setting(content["overrides"]) if content["overrides"] else "",
        count=content["episodes"],
        names=[run["name"] for run in runs],
        notes=content["notes"],
        overview=_overview(runs),
        least_pairs=LEAST_PAIRS,
        groups=_groups(runs, metrics_of(content)),
        judged=_judged_tables(content),
        several=any(run["training_seeds"] > 1 for run in runs),
        by_cell=BY_CELL,
        cells=_cells(content),
        **strata,
        commands=[(run["name"], run["command"] or run["source"]) for run in runs],
        documents={heading: json.dumps(value, indent=1) for heading, value in documents.items()},
    )
