"""report.html: one self-contained page with the score, its parts, the suite's cells, trajectories, distributions, films."""

import html
import json

import numpy as np

from bson import heatmap
from bson.heatmap import Scale, Tile, cell_maps
from bson.metrics import GROUPS, METRICS, spread_by_score
from bson.page import ACCENT, BAD, GRID, INK, image, new_figure, numbers, page, plural, video

# (metric, heading, unit, decimals, what it is) of the cards and the tables of cells and episodes
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
_BETTER = {"up": "&uarr;", "down": "&darr;", "": "&ndash;"}

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


def plot_distribution(values, least):
    """A histogram of `values`, with their mean; None doesn't enter. The axis covers at least 0 to `least`."""
    figure = new_figure(figsize=(3.3, 1.9))
    axes = figure.subplots()
    values = np.array([value for value in values if value is not None])
    axes.spines[["top", "right"]].set_visible(False)
    axes.yaxis.get_major_locator().set_params(integer=True)
    if not len(values):
        axes.text(0.5, 0.5, "no people", ha="center", va="center", transform=axes.transAxes)
        return figure
    low, high = min(0.0, values.min()), max(least, values.max())
    axes.hist(values, bins=np.linspace(low, high, 21), color=ACCENT, edgecolor="white", linewidth=0.6)
    axes.axvline(values.mean(), color=BAD, linewidth=1.5)
    return figure


def plot_trajectory(episode):
    """A map with the robot's way, black, from the dot to the star, and the people's, coloured by LCF, to the discs."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Circle, Rectangle
    from matplotlib.transforms import Affine2D

    from macid.drawing import lcf_colour

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
        axes.add_patch(Circle(way[-1], 0.35, color=colour, linewidth=0))
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


def plot_score_over_lcf(episodes):
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


def _metric_rows(content, metrics, meaning):
    """Rows of a table of `metrics`; meaning: whether with a column of what each is."""
    rows = []
    for metric in metrics:
        value, interval, few = "&ndash;", "", ""
        if metric.name in content["summary"]:
            low, high = content["intervals"][metric.name]
            value, *ends = numbers(content["summary"][metric.name], low, high)
            interval = " to ".join(ends)
            entered, count = content["counts"][metric.name], len(content["episodes"])
            few = f"<br><small>{entered} of {count} episodes</small>" if entered < count else ""
        what = f'<td class="left">{html.escape(metric.what)}</td>' if meaning else ""
        rows.append(
            f'<tr><td class="left" title="{html.escape(metric.what)}">{metric.name} '
            f"<small>{metric.unit} {_BETTER[metric.better]}</small>{few}</td><td><b>{value}</b></td>"
            f'<td class="nowrap">{interval}</td>{what}</tr>'
        )
    return "".join(rows)


def _metric_tables(content):
    """The groups after the score side by side, and folded away what every metric is, the minor ones among them."""
    head = '<tr><th class="left">metric <small>unit, better</small></th><th>mean</th><th>95% interval</th>'
    shown = [group for group in GROUPS[1:] if any(m.group == group and m.name in content["summary"] for m in METRICS)]
    groups = "".join(
        f'<div><h3>{group.capitalize()}</h3><div class="plain"><table>{head}</tr>'
        + _metric_rows(content, [m for m in METRICS if m.group == group and not m.minor], False)
        + "</table></div></div>"
        for group in shown
    )
    return (
        f'<h2>{", ".join(shown).capitalize()}</h2><div class="groups">{groups}</div>'
        f"<details><summary>All {len(METRICS)} metrics, and what each is</summary>"
        f'<div class="plain"><table>{head}<th class="left">what</th></tr>'
        f"{_metric_rows(content, METRICS, True)}</table></div>"
        "<p class=sub>Infinite values (nobody there, goal not reached, on no collision course) don't enter a mean. "
        "Space shares contain one another: who is within 0.45 m is within 1.2 m too. After Francis et al. 2023.</p></details>"
    )


def _maps(cells):
    """SNS, success and collisions over the axes of the suite's `cells`."""

    def tiles(name):
        return [
            Tile(cell["grades"], cell["summary"].get(name), *cell["intervals"].get(name, (None, None)))
            for cell in cells
        ]

    most = max([10.0, *(cell["intervals"]["Coll"][1] for cell in cells if "Coll" in cell["intervals"])])
    maps = [
        cell_maps(tiles("SNS"), Scale(0.0, 100.0), "SNS", "of 100, more is better", 1),
        cell_maps(tiles("success"), Scale(0.0, 1.0), "Success", "share that reached the goal", 2),
        cell_maps(tiles("Coll"), Scale(0.0, most, "down", True), "Collision steps", "of 0.02 s; less is better"),
    ]
    return f'<div class="dotplots">{"".join(maps)}</div>' if len(cells[0]["grades"]) == 1 else "".join(maps)


def _cell_table(cells):
    """The cells from the worst SNS to the best."""
    axes = "".join(f'<th class="left">{html.escape(axis)}</th>' for axis in cells[0]["grades"])
    header = "".join(f"<th>{label}</th>" for _, label, *_ in _SHOWN)
    rows = []
    for cell in sorted(cells, key=lambda cell: (cell["summary"].get("SNS", -np.inf), cell["name"])):
        grades = "".join(f'<td class="left nowrap">{html.escape(grade)}</td>' for grade in cell["grades"].values())
        values = [
            f"{cell['summary'][name]:.{digits}f}" if name in cell["summary"] else "&ndash;"
            for name, _, _, digits, _ in _SHOWN
        ]
        if "SNS" in cell["summary"]:
            low, high = cell["intervals"]["SNS"]
            values[0] = f"<b>{values[0]}</b> <small>[{low:.1f}, {high:.1f}]</small>"
        shown = "".join(f'<td class="nowrap">{value}</td>' for value in values)
        rows.append(f"<tr>{grades}<td>{cell['episodes']}</td>{shown}</tr>")
    return f'<div class="scroll"><table><tr>{axes}<th>episodes</th>{header}</tr>{"".join(rows)}</table></div>'


def grade_settings(cells):
    """What each grade of a suite's `cells` sets: {axis: {grade: {field: value}}}, as far as one axis alone decides it."""
    configs = [cell["config"] for cell in cells]
    varying = [field for field in configs[0] if any(config[field] != configs[0][field] for config in configs)]
    found = {}
    for axis in cells[0]["grades"]:
        grades = list(dict.fromkeys(cell["grades"][axis] for cell in cells))
        of = {grade: [cell["config"] for cell in cells if cell["grades"][axis] == grade] for grade in grades}
        decided = [f for f in varying if all(c[f] == group[0][f] for group in of.values() for c in group)]
        found[axis] = {grade: {field: of[grade][0][field] for field in decided} for grade in grades}
    return found


def _grades_table(cells):
    rows = "".join(
        f'<tr><td class="left">{html.escape(axis)}</td><td class="left">{html.escape(grade)}</td>'
        f'<td class="left">{html.escape(", ".join(f"{field} = {value}" for field, value in fields.items()))}</td></tr>'
        for axis, grades in grade_settings(cells).items()
        for grade, fields in grades.items()
    )
    return (
        '<details><summary>What the grades are</summary><div class="plain"><table><tr><th class="left">axis</th>'
        f'<th class="left">grade</th><th class="left">sets</th></tr>{rows}</table></div></details>'
    )


def _fault_table(faults):
    rows = "".join(
        f"<tr><td>{fault['seed']}</td><td class=left>{html.escape(fault['cell'])}</td><td>{fault['time']:.2f} s</td>"
        f"<td class=left>{html.escape(fault['what'])}</td></tr>"
        for fault in faults
    )
    return (
        f'<h2>Faults</h2><p class="note">{plural(len(faults), "episode")} ended in a fault of the simulation and '
        f'did not enter any figure of this page.</p><div class="scroll"><table><tr><th>seed</th><th class=left>cell</th>'
        f"<th>after</th><th class=left>what</th></tr>{rows}</table></div>"
    )


def _episode_table(rows, several):
    """rows: of results.json, ascending in SNS; several: whether the suite has several cells."""
    header = "".join(f"<th>{label}</th>" for _, label, *_ in _SHOWN)
    lines = []
    for row in rows:
        values = "".join(
            f"<td>{'&ndash;' if row[name] is None else f'{row[name]:.{digits}f}'}</td>"
            for name, _, _, digits, _ in _SHOWN
        )
        cell = f'<td class="left nowrap">{html.escape(row["cell"])}</td>' if several else ""
        lines.append(f"<tr><td>{row['seed']}</td>{cell}{values}</tr>")
    cell = '<th class="left">cell</th>' if several else ""
    return f'<div class="scroll"><table><tr><th>seed</th>{cell}{header}</tr>{"".join(lines)}</table></div>'


def _settings(content, cells):
    """The command, and the configuration, which is folded away."""
    what = "of the first cell" if len(cells) > 1 else "of the episodes"
    shown = {"configuration " + what: content["config"], "versions": content["versions"]}
    command = f'<pre class="wrap">{html.escape(content["command"])}</pre>' if content.get("command") else ""
    digest = content.get("suite_digest")
    frozen = f" (digest <code>{html.escape(digest)}</code>)" if digest else ""
    changed = ", ".join(f"{key} = {value}" for key, value in content.get("overrides", {}).items())
    changed = f"; changed from the suite: {html.escape(changed)}" if changed else ""
    folded = "".join(
        f"<details><summary>{name.capitalize()}</summary><pre>{html.escape(json.dumps(value, indent=1))}</pre></details>"
        for name, value in shown.items()
    )
    return (
        f'<h2>Made with</h2><p class="sub">Suite <b>{html.escape(content["suite"])}</b>{frozen}{changed}.</p>'
        f"{command}{folded}"
    )


def _ways(episodes, rows, several):
    """Maps of nine episodes, evenly from the worst SNS to the best."""
    of = {id(episode): row for episode, row in zip(episodes, rows, strict=True)}
    maps = []
    for episode in spread_by_score(episodes, 9):
        row = of[id(episode)]
        where = f"{row['cell']}, " if several else ""
        maps.append(
            image(
                plot_trajectory(episode),
                f"{where}seed {row['seed']}: SNS {row['SNS']:.1f}, {row['Coll']:.0f} collision steps, {row['time']:.0f} s",
            )
        )
    return f'<div class="ways">{"".join(maps)}</div>'


def _amount(counts):
    """Such as "24" or "25 to 200"."""
    return f"{min(counts)} to {max(counts)}" if min(counts) < max(counts) else f"{counts[0]}"


def make_report(content, episodes, videos=(), no_video=""):
    """The page as text.

    content: of results.json. episodes: those of its rows, in the same order. videos: (path, caption) pairs of .webm
    files, embedded. no_video: why there are none.
    """
    cells = content.get("cells", [])
    several = len(cells) > 1
    summary, intervals, rows = content["summary"], content["intervals"], content["episodes"]
    low, high = intervals["SNS"]
    models = {str(cell["config"]["pedestrian_model"]): None for cell in cells or [content]}
    people = _amount([episode.people.shape[1] for episode in episodes])
    cards = "".join(
        f'<div class="card"><span>{label}</span><b>{summary[name]:.{digits}f}{unit}</b> '
        f"<small>[{intervals[name][0]:.{digits}f}, {intervals[name][1]:.{digits}f}]</small><span>{what}</span></div>"
        for name, label, unit, digits, what in _SHOWN[1:]
        if name in summary
    )
    films = "".join(video(path, caption) for path, caption in videos)
    if no_video:
        films = f"<p class=sub>{html.escape(no_video)}</p>"
    histograms = "".join(
        image(plot_distribution([row[name] for row in rows], least), label) for name, label, least in _DISTRIBUTIONS
    )
    by_lcf = plot_score_over_lcf(episodes)
    strata = f"<h2>Cells</h2>{_maps(cells)}<h3>From the worst to the best</h3>{_cell_table(cells)}" if several else ""
    body = f"""<h1>{html.escape(content["agent"])} among {people} people</h1>
<p class="sub">BSON suite <b>{html.escape(content["suite"])}</b>,
{plural(len(cells), "cell") + ", " if several else ""}{plural(len(episodes), "episode")}; pedestrians:
{html.escape(", ".join(models))}; means with bootstrap 95% intervals.</p>
<div class="top"><div class="head"><small>Socially-aware navigation score</small><b>{summary["SNS"]:.1f}</b>
<small>of 100 &nbsp; 95% interval {low:.1f} to {high:.1f}</small></div><div class="cards">{cards}</div></div>
<p class="sub">SNS = mean of RC &middot; 0.95<sup>Coll</sup> &middot; (50 PE + 50 SP) over the episodes; an RC below 0 counts without the discount.</p>
{_fault_table(content["faults"]) if content.get("faults") else ""}
{strata}{_grades_table(cells) if several else ""}
{_metric_tables(content)}
<h2>Films</h2><div class="films">{films or '<p class="sub">None were asked for.</p>'}</div>
<h2>Ways, from the worst episode to the best</h2>
<p class="sub">Robot black, from the dot to the star; people coloured by LCF, a disc where they ended.</p>
{_ways(episodes, rows, several)}
<h2>Distributions over episodes</h2><p class="sub">Red line: mean.</p><div class="histograms">{histograms}</div>
{f'<h2>Whom the robot met</h2><div class="wide">{image(by_lcf, "One dot an episode.")}</div>' if by_lcf else ""}
<h2>Episodes</h2>{_episode_table(sorted(rows, key=lambda row: row["SNS"]), several)}
{_settings(content, cells)}"""
    return page(f"{content['agent']} on {content['suite']}", body, heatmap.STYLE)
