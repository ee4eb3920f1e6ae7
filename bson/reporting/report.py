"""report.html: one self-contained page with the score, its parts, the suite's cells, ways, distributions and films."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from bson.episodes.record import Episode
from bson.evaluation.metrics import GROUPS, metrics_of, spread_by_score
from bson.reporting.heatmap import Scale, Tile, cell_maps
from bson.reporting.page import BETTER, DASH, image, numbers, render, video
from macid.pages import ACCENT, BAD, GRID, INK, new_figure

# (metric, heading, unit, decimals, meaning) of the cards and the tables of cells and episodes
_SHOWN = (
    ("SNS", "SNS", "", 1, "the score, of 100"),
    ("RC", "Route completion", "", 3, "1 - d_f / d_i"),
    ("Coll", "Collision steps", "", 1, "steps of 0.02 s in contact"),
    ("SP", "Speed score", "", 3, "of 0.5 to 1.5 m/s"),
    ("PE", "Path efficiency", "", 3, "progress over way driven"),
    ("success", "Success", "", 2, "share at the goal in time"),
    ("time", "Time", " s", 1, "duration of an episode"),
    ("nearest_person", "Nearest person", " m", 2, "least surface distance"),
    ("personal_space", "Personal space", "", 3, "share of time within 1.2 m"),
)

# (metric, label, the least end of the axis) of the histograms
_DISTRIBUTIONS = (
    ("SNS", "SNS", 100.0),
    ("Coll", "Collision steps", 1.0),
    ("time", "Time [s]", 1.0),
    ("nearest_person", "Nearest person [m]", 1.0),
    ("RC", "Route completion RC", 1.0),
    ("SP", "Speed score SP", 1.0),
    ("PE", "Path efficiency PE", 1.0),
    ("personal_space", "Share of time within 1.2 m of a person", 1.0),
)


def plot_distribution(values: Sequence[float | None], least: float) -> Any:
    """A histogram of `values`, with their mean; None doesn't enter. The axis covers at least 0 to `least`."""
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(figsize=(3.3, 1.9))
    axes = figure.subplots()
    known = np.array([value for value in values if value is not None])
    axes.spines[["top", "right"]].set_visible(False)
    locator = axes.yaxis.get_major_locator()
    assert isinstance(locator, MaxNLocator)  # the locator of a linear axis
    locator.set_params(integer=True)
    if not len(known):
        axes.text(0.5, 0.5, "no people", ha="center", va="center", transform=axes.transAxes)
        return figure
    low, high = min(0.0, known.min()), max(least, known.max())
    axes.hist(known, bins=np.linspace(low, high, 21), color=ACCENT, edgecolor="white", linewidth=0.6)
    axes.axvline(known.mean(), color=BAD, linewidth=1.5)
    return figure


def plot_trajectory(episode: Episode) -> Any:
    """A map with the robot's way, black, from the dot to the star, and the people's, coloured by LCF, to the discs."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Circle, Rectangle
    from matplotlib.transforms import Affine2D

    from macid.drawing.colours import lcf_colour

    figure = new_figure(figsize=(4.0, 4.0))
    axes = figure.subplots()
    for x, y, half_x, half_y, yaw in episode.boxes:
        box = Rectangle((-half_x, -half_y), 2 * half_x, 2 * half_y, color="#7d8791", linewidth=0)
        box.set_transform(Affine2D().rotate(yaw).translate(x, y) + axes.transData)
        axes.add_patch(box)
    colours = lcf_colour(episode.lcf)
    ways = [way for way in np.moveaxis(episode.people[..., :2], 1, 0)]
    axes.add_collection(LineCollection(ways, colors=colours, linewidths=0.8, alpha=0.45))
    for way, colour in zip(ways, colours, strict=True):
        axes.add_patch(Circle(way[-1], episode.person_radius, color=colour, linewidth=0))
    axes.plot(*episode.pose[:, :2].T, color=INK, linewidth=2.0)
    axes.plot(*episode.pose[0, :2], "o", color=INK, markersize=5)
    axes.plot(*episode.goal, "*", color="#e0a100", markersize=13, markeredgecolor=INK, markeredgewidth=0.6)
    half = np.abs(episode.boxes[:4, :2]).max() + 0.3
    points = np.concatenate([episode.pose[:, :2], episode.goal[None]])
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    reach = min(half, max(np.ptp(points, axis=0).max() / 2 + 4.0, 8.0))
    centre = np.clip(centre, -(half - reach), half - reach)
    axes.set_xlim(centre[0] - reach, centre[0] + reach)
    axes.set_ylim(centre[1] - reach, centre[1] + reach)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=8, color=GRID)
    axes.spines[:].set_color(GRID)
    return figure


def plot_score_over_lcf(episodes: Sequence[Episode]) -> Any:
    """None where nobody walks; else collision steps with people against the mean LCF of the people met within 3.6 m."""
    met = []
    for episode in episodes:
        if not episode.people.shape[1]:
            return None
        gap = np.linalg.norm(episode.people[..., :2] - episode.pose[:, None, :2], axis=-1).min(axis=0)
        near = gap < 3.6
        if near.any():
            met.append((episode.lcf[near].mean(), episode.collisions_person))
    if len(met) < 3:
        return None
    lcf, collisions = np.array(met).T
    figure = new_figure(figsize=(6.6, 2.8))
    axes = figure.subplots()
    axes.plot(lcf, collisions, "o", color=ACCENT, alpha=0.7)
    axes.set_yscale("symlog", linthresh=1)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_ylim(bottom=-0.1)
    axes.set_xlabel("mean LCF of the people who came within 3.6 m")
    axes.set_ylabel("collision steps with people")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _metric_row(content, metric):
    """A table's row for a metric."""
    row = {"metric": metric, "better": BETTER[metric.better] or DASH, "value": DASH, "interval": "", "few": ""}
    if metric.name in content["summary"]:
        low, high = content["intervals"][metric.name]
        row["value"], *ends = numbers(content["summary"][metric.name], low, high)
        row["interval"] = " to ".join(ends)
        entered, count = content["counts"][metric.name], len(content["episodes"])
        row["few"] = f"{entered} of {count} episodes" if entered < count else ""
    return row


def _metric_groups(content):
    """{group: rows of its metrics} of the groups after the score, the minor metrics left out."""
    metrics = metrics_of(content)
    shown = [group for group in GROUPS[1:] if any(m.group == group and m.name in content["summary"] for m in metrics)]
    return {
        group: [_metric_row(content, metric) for metric in metrics if metric.group == group and not metric.minor]
        for group in shown
    }


def _maps(cells):
    """SNS, success and collisions over the axes of the suite's `cells`, each as HTML."""

    def tiles(name):
        return [
            Tile(cell["grades"], cell["summary"].get(name), *cell["intervals"].get(name, (None, None)))
            for cell in cells
        ]

    most = max([10.0, *(cell["intervals"]["Coll"][1] for cell in cells if "Coll" in cell["intervals"])])
    return [
        cell_maps(tiles("SNS"), Scale(0.0, 100.0), "SNS", "of 100, more is better", 1),
        cell_maps(tiles("success"), Scale(0.0, 1.0), "Success", "share that reached the goal", 2),
        cell_maps(tiles("Coll"), Scale(0.0, most, "down", True), "Collision steps", "of 0.02 s; less is better"),
    ]


def _ranked(cells):
    """The rows of the table of `cells`, from the worst SNS to the best."""
    rows = []
    for cell in sorted(cells, key=lambda cell: (cell["summary"].get("SNS", -np.inf), cell["name"])):
        row = {"grades": list(cell["grades"].values()), "episodes": cell["episodes"], "interval": ""}
        if "SNS" in cell["summary"]:
            low, high = cell["intervals"]["SNS"]
            row["interval"] = f"[{low:.1f}, {high:.1f}]"
        rows.append(row | {"figures": _figures(cell["summary"])})
    return rows


def _figures(values):
    """The texts in the tables of cells and episodes for `values`, {metric: number or None}."""
    return [DASH if values.get(name) is None else f"{values[name]:.{digits}f}" for name, _, _, digits, _ in _SHOWN]


def grade_settings(cells: Sequence[dict[str, Any]]) -> dict[str, dict[str, dict[str, Any]]]:
    """The fields that each grade of a suite's `cells` sets: {axis: {grade: {field: value}}}, where one axis alone
    decides it."""
    configs = [cell["config"] for cell in cells]
    varying = [field for field in configs[0] if any(config[field] != configs[0][field] for config in configs)]
    found = {}
    for axis in cells[0]["grades"]:
        grades = list(dict.fromkeys(cell["grades"][axis] for cell in cells))
        of = {grade: [cell["config"] for cell in cells if cell["grades"][axis] == grade] for grade in grades}
        decided = [f for f in varying if all(c[f] == group[0][f] for group in of.values() for c in group)]
        found[axis] = {grade: {field: of[grade][0][field] for field in decided} for grade in grades}
    return found


def _grades(cells):
    """Rows (axis, grade, the fields that it sets)."""
    return [
        (axis, grade, ", ".join(f"{field} = {value}" for field, value in fields.items()))
        for axis, grades in grade_settings(cells).items()
        for grade, fields in grades.items()
    ]


def _ways(episodes, rows, several):
    """Maps of nine episodes, evenly from the worst SNS to the best, each as HTML."""
    of = {id(episode): row for episode, row in zip(episodes, rows, strict=True)}
    maps = []
    for episode in spread_by_score(episodes, 9):
        row = of[id(episode)]
        where = f"{row['cell']}, " if several else ""
        maps.append(
            image(
                plot_trajectory(episode),
                f"{where}seed {row['seed']}: SNS {row['SNS']:.1f}, {row['Coll']:.0f} collision steps, "
                f"{row['time']:.0f} s",
            )
        )
    return maps


def _amount(counts):
    """Counts in words, such as "24" or "25 to 200"."""
    return f"{min(counts)} to {max(counts)}" if min(counts) < max(counts) else f"{counts[0]}"


def make_report(
    content: dict[str, Any], episodes: Sequence[Episode], videos: Sequence[Any] = (), no_video: str | None = ""
) -> str:
    """The page report.html as text.

    content: the content of results.json. episodes: the Episodes of its rows, in the same order. videos: (path, caption)
    pairs of .webm files to embed. no_video: the reason if there are none.
    """
    cells = content.get("cells", [])
    several = len(cells) > 1
    summary, intervals, rows = content["summary"], content["intervals"], content["episodes"]
    cards = [
        {"label": label, "what": what, "unit": unit}
        | dict(zip(("value", "low", "high"), numbers(summary[name], *intervals[name], digits=digits), strict=True))
        for name, label, unit, digits, what in _SHOWN[1:]
        if name in summary
    ]
    score, *interval = numbers(summary["SNS"], *intervals["SNS"], digits=1)
    by_lcf = plot_score_over_lcf(episodes)
    of = "of the first cell" if several else "of the episodes"
    documents = {f"Configuration {of}": content["config"], "Versions": content["versions"]}
    strata = (
        {"axes": list(cells[0]["grades"]), "maps": _maps(cells), "ranked": _ranked(cells), "grades": _grades(cells)}
        if several
        else {}
    )
    return render(
        "report.html",
        title=f"{content['agent']} on {content['suite']}",
        agent=content["agent"],
        people=_amount([episode.people.shape[1] for episode in episodes]),
        suite=content["suite"],
        several=several,
        cells=cells,
        count=len(episodes),
        models=list({str(cell["config"]["pedestrian_model"]): None for cell in cells or [content]}),
        score=score,
        interval=interval,
        cards=cards,
        faults=content.get("faults", []),
        **strata,
        groups=_metric_groups(content),
        metrics=[_metric_row(content, metric) for metric in metrics_of(content)],
        films=[video(path, caption) for path, caption in videos],
        no_video=no_video,
        ways=_ways(episodes, rows, several),
        histograms=[
            image(plot_distribution([row[name] for row in rows], least), label) for name, label, least in _DISTRIBUTIONS
        ],
        by_lcf=image(by_lcf, "One dot an episode.") if by_lcf else "",
        headings=[label for _, label, *_ in _SHOWN],
        episodes=[row | {"figures": _figures(row)} for row in sorted(rows, key=lambda row: row["SNS"])],
        digest=content.get("suite_digest"),
        changed=", ".join(f"{key} = {value}" for key, value in content.get("overrides", {}).items()),
        command=content.get("command"),
        documents={heading: json.dumps(value, indent=1) for heading, value in documents.items()},
    )
