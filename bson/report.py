"""report.html: one self-contained page with the score, its parts, trajectories, distributions and the videos."""

import base64
import html
import io
import json

import numpy as np

from bson.metrics import GROUPS, METRICS, measure, spread_by_score

_INK, _ACCENT, _BAD, _GRID = "#1d2733", "#1f6f8b", "#c0392b", "#d9dfe5"

# (metric, heading, unit, decimals, what it is) of the cards and the episode table
_SHOWN = (
    ("SNS", "SNS", "", 1, "the score, of 100"),
    ("RC", "Route completion", "", 3, "1 - d_f / d_i"),
    ("Coll", "Collision steps", "", 1, "steps of 0.02 s in contact"),
    ("SP", "Speed score", "", 3, "0.5 to 1.5 m/s mean speed"),
    ("PE", "Path efficiency", "", 3, "progress over way driven"),
    ("success", "Success", "", 2, "share that reached the goal"),
    ("time", "Time", " s", 1, "duration of an episode"),
    ("nearest_person", "Nearest person", " m", 2, "least surface distance"),
)

_STYLE = """
body{font:15px/1.5 system-ui,-apple-system,'Segoe UI',Roboto,sans-serif;color:#1d2733;background:#f4f6f8;margin:0}
main{max-width:1180px;margin:0 auto;padding:28px 24px 60px}
h1{font-size:26px;margin:0 0 2px} h2{font-size:18px;margin:34px 0 10px} .sub{color:#5b6876;margin:0 0 20px}
.top{display:grid;grid-template-columns:260px 1fr;gap:16px}
.head{background:#1f6f8b;color:#fff;border-radius:12px;padding:18px 22px}
.head b{font-size:58px;line-height:1.05;display:block} .head small{opacity:.85}
.cards{display:grid;grid-template-columns:repeat(auto-fill,minmax(185px,1fr));gap:12px}
.card{background:#fff;border:1px solid #e1e6eb;border-radius:10px;padding:10px 14px}
.card b{font-size:23px} .card span{display:block;color:#5b6876;font-size:13px} .card small{color:#5b6876}
figure{margin:0 0 14px;background:#fff;border:1px solid #e1e6eb;border-radius:10px;padding:12px}
figure img,figure video{width:100%;display:block;border-radius:6px} figcaption{color:#5b6876;font-size:13px;margin-top:6px}
.scroll{max-height:420px;overflow:auto;background:#fff;border:1px solid #e1e6eb;border-radius:10px}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums} th,td{padding:5px 12px;text-align:right}
th{position:sticky;top:0;background:#eef2f5;font-weight:600} tr:nth-child(even) td{background:#fafbfc}
.groups{display:grid;grid-template-columns:repeat(auto-fit,minmax(355px,1fr));gap:16px;align-items:start}
.groups h3{font-size:14px;margin:0 0 6px;color:#5b6876} .groups td,.groups th{padding:3px 9px;font-size:13px}
.plain{background:#fff;border:1px solid #e1e6eb;border-radius:10px;overflow:auto}
.left{text-align:left} td small{color:#5b6876} details{margin-top:12px} summary{cursor:pointer;color:#1f6f8b}
details .plain{margin-top:8px} details td,details th{font-size:13px;padding:3px 12px}
pre{background:#fff;border:1px solid #e1e6eb;border-radius:10px;padding:12px;overflow:auto;font-size:13px}
"""


def _figure_png(figure):
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, facecolor="white")
    return base64.b64encode(buffer.getvalue()).decode()


def _new_figure(*args, **kwargs):
    """A figure drawn without pyplot, so that no display or global state is touched."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(*args, **kwargs)
    FigureCanvasAgg(figure)
    return figure


def plot_distributions(measured):
    """Histograms of the score, its parts, time and distance to people over the episodes `measured` (dicts of `measure`)."""
    figure = _new_figure(figsize=(11.5, 4.6), layout="constrained")
    names = ("SNS", "Coll", "time", "nearest_person", "RC", "SP", "PE", "personal_space")
    labels = (
        "SNS",
        "collision steps",
        "time [s]",
        "nearest person [m]",
        "route completion RC",
        "speed score SP",
        "path efficiency PE",
        "share of time within 1.2 m of a person",
    )
    unit = {"SNS": (0, 100), "RC": (0, 1), "SP": (0, 1), "PE": (0, 1), "personal_space": (0, 1)}
    for axes, name, label in zip(figure.subplots(2, 4).ravel(), names, labels, strict=True):
        values = np.array([row[name] for row in measured])
        values = values[np.isfinite(values)]
        axes.set_xlabel(label)
        axes.spines[["top", "right"]].set_visible(False)
        axes.yaxis.get_major_locator().set_params(integer=True)
        if not len(values):
            axes.text(0.5, 0.5, "no people", ha="center", va="center", transform=axes.transAxes)
            continue
        low, high = unit.get(name, (0.0, 0.0))
        low, high = min(low, values.min()), max(high, values.max()) + 1e-9
        axes.hist(values, bins=np.linspace(low, high, 21), color=_ACCENT, edgecolor="white", linewidth=0.6)
        axes.axvline(values.mean(), color=_BAD, linewidth=1.5)
    return figure


def plot_trajectories(episodes, most=9):
    """Maps with the robot's and the people's ways: the episodes spread evenly from the worst SNS to the best."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Circle, Rectangle
    from matplotlib.transforms import Affine2D

    from macid.drawing import lcf_colour

    chosen = spread_by_score(episodes, most)
    columns = min(3, len(chosen))
    rows = -(-len(chosen) // columns)
    figure = _new_figure(figsize=(11.5, 4.1 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in grid[len(chosen) :]:
        axes.set_axis_off()
    for axes, episode in zip(grid, chosen, strict=False):
        for x, y, half_x, half_y, yaw in episode.boxes:
            box = Rectangle((-half_x, -half_y), 2 * half_x, 2 * half_y, color="#7d8791", linewidth=0)
            box.set_transform(Affine2D().rotate(yaw).translate(x, y) + axes.transData)
            axes.add_patch(box)
        colours = lcf_colour(episode.lcf)
        ways = [way for way in np.moveaxis(episode.people[..., :2], 1, 0)]
        axes.add_collection(LineCollection(ways, colors=colours, linewidths=0.8, alpha=0.45))
        for way, colour in zip(ways, colours, strict=True):
            axes.add_patch(Circle(way[-1], 0.35, color=colour, linewidth=0))
        axes.plot(*episode.pose[:, :2].T, color=_INK, linewidth=2.0)
        axes.plot(*episode.pose[0, :2], "o", color=_INK, markersize=5)
        axes.plot(*episode.goal, "*", color="#e0a100", markersize=13, markeredgecolor=_INK, markeredgewidth=0.6)
        metrics = measure(episode)
        axes.set_title(
            f"seed {episode.seed}: SNS {metrics['SNS']:.1f}, {metrics['Coll']:.0f} collision steps, {metrics['time']:.0f} s",
            fontsize=10,
        )
        half = np.abs(episode.boxes[:4, :2]).max() + 0.3
        points = np.concatenate([episode.pose[:, :2], episode.goal[None]])
        centre = (points.min(axis=0) + points.max(axis=0)) / 2
        reach = min(half, max(np.ptp(points, axis=0).max() / 2 + 4.0, 8.0))
        centre = np.clip(centre, -(half - reach), half - reach)
        axes.set_xlim(centre[0] - reach, centre[0] + reach)
        axes.set_ylim(centre[1] - reach, centre[1] + reach)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=8, color=_GRID)
        axes.spines[:].set_color(_GRID)
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
    figure = _new_figure(figsize=(11.5, 3.0), layout="constrained")
    axes = figure.subplots()
    axes.plot(lcf, collisions, "o", color=_ACCENT, alpha=0.7)
    axes.set_yscale("symlog", linthresh=1)
    axes.yaxis.set_major_formatter("{x:g}")
    axes.set_ylim(bottom=-0.1)
    axes.set_xlabel("mean LCF of the people who came within 3.6 m")
    axes.set_ylabel("collision steps with people")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _image(figure, caption):
    return (
        f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,{_figure_png(figure)}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


def _video(path, caption):
    content = base64.b64encode(path.read_bytes()).decode()
    return (
        f'<figure><video controls preload="metadata" src="data:video/webm;base64,{content}"></video>'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


_BETTER = {"up": "&uarr;", "down": "&darr;", "": "&ndash;"}


def _figure(value):
    """Three digits, never as a power of ten."""
    return f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"


def _metric_rows(content, metrics, meaning):
    """Rows of a table of `metrics`; meaning: whether with a column of what each is."""
    rows = []
    for metric in metrics:
        value, interval, few = "&ndash;", "", ""
        if metric.name in content["summary"]:
            low, high = content["intervals"][metric.name]
            value, interval = _figure(content["summary"][metric.name]), f"{_figure(low)} to {_figure(high)}"
            entered, count = content["counts"][metric.name], len(content["episodes"])
            few = f" <small>({entered} of {count} episodes)</small>" if entered < count else ""
        what = f'<td class="left">{html.escape(metric.what)}</td>' if meaning else ""
        rows.append(
            f'<tr><td class="left" title="{html.escape(metric.what)}">{metric.name}{few}</td><td><b>{value}</b></td>'
            f'<td>{interval}</td><td class="left">{metric.unit} {_BETTER[metric.better]}</td>{what}</tr>'
        )
    return "".join(rows)


def _metric_tables(content):
    """The groups after the score side by side, and folded away what every metric is, the minor ones among them."""
    head = '<tr><th class="left">metric</th><th>mean</th><th>95% interval</th><th class="left">unit, better</th>'
    groups = "".join(
        f'<div><h3>{group.capitalize()}</h3><div class="plain"><table>{head}</tr>'
        + _metric_rows(content, [m for m in METRICS if m.group == group and not m.minor], False)
        + "</table></div></div>"
        for group in GROUPS[1:]
    )
    return (
        f'<div class="groups">{groups}</div><details><summary>All {len(METRICS)} metrics, and what each is</summary>'
        f'<div class="plain"><table>{head}<th class="left">what</th></tr>'
        f"{_metric_rows(content, METRICS, True)}</table></div>"
        "<p class=sub>Infinite values (nobody there, goal not reached, on no collision course) don't enter a mean. "
        "Space shares contain one another: who is within 0.45 m is within 1.2 m too. After Francis et al. 2023.</p></details>"
    )


def make_report(content, episodes, videos=(), no_video=""):
    """The page as text.

    content: of results.json. videos: (path, caption) pairs of .webm files, embedded. no_video: why there are none.
    """
    measured = [measure(episode) for episode in episodes]
    summary, intervals, count = content["summary"], content["intervals"], len(episodes)
    low, high = intervals["SNS"]
    cards = "".join(
        f'<div class="card"><span>{label}</span><b>{summary[name]:.{digits}f}{unit}</b> '
        f"<small>[{intervals[name][0]:.{digits}f}, {intervals[name][1]:.{digits}f}]</small><span>{what}</span></div>"
        for name, label, unit, digits, what in _SHOWN[1:]
        if name in summary
    )
    header = "".join(f"<th>{label}</th>" for _, label, *_ in _SHOWN)
    rows = "".join(
        f"<tr><td>{episode.seed}</td>"
        + "".join(f"<td>{row[name]:.{digits}f}</td>" for name, _, _, digits, _ in _SHOWN)
        + "</tr>"
        for episode, row in sorted(zip(episodes, measured, strict=True), key=lambda pair: pair[1]["SNS"])
    )
    films = "".join(_video(path, caption) for path, caption in videos)
    if no_video:
        films = f"<p class=sub>{html.escape(no_video)}</p>"
    by_lcf = plot_score_over_lcf(episodes)
    settings = json.dumps({key: content[key] for key in ("config", "versions")}, indent=1)
    command = content.get("command", "")
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{html.escape(content["agent"])} on {html.escape(content["suite"])}</title>
<meta name="viewport" content="width=device-width,initial-scale=1"><style>{_STYLE}</style></head><body><main>
<h1>{html.escape(content["agent"])} among {content["people"]} people</h1>
<p class="sub">BSON suite <b>{html.escape(content["suite"])}</b>, {count} episode{"s" if count != 1 else ""}; pedestrians:
{html.escape(content["config"]["pedestrian_model"])}; means with bootstrap 95% intervals.</p>
<div class="top"><div class="head"><small>Socially-aware navigation score</small><b>{summary["SNS"]:.1f}</b>
<small>of 100 &nbsp; 95% interval {low:.1f} to {high:.1f}</small></div><div class="cards">{cards}</div></div>
<p class="sub">SNS = mean of RC &middot; 0.95<sup>Coll</sup> &middot; (50 PE + 50 SP) over the episodes.</p>
<h2>Safety, comfort, efficiency</h2>{_metric_tables(content)}
<h2>Films</h2>{films or '<p class="sub">None were asked for.</p>'}
<h2>Ways, from the worst episode to the best</h2>
{_image(plot_trajectories(episodes), "Robot black, from the dot to the star; people coloured by LCF, a disc where they ended.")}
<h2>Distributions over episodes</h2>
{_image(plot_distributions(measured), "Red line: mean.")}
{_image(by_lcf, "Whom the robot met, and how often they touched: one dot an episode.") if by_lcf else ""}
<h2>Episodes</h2><div class="scroll"><table><tr><th>seed</th>{header}</tr>{rows}</table></div>
<h2>Setting</h2><pre>{html.escape(command)}</pre><pre>{html.escape(settings)}</pre>
</main></body></html>
"""
