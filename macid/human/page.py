"""The page of a measured model: one HTML file with its table, plots and film."""

import pathlib
from typing import Any

import numpy as np

from macid.files import write_bytes
from macid.human import figures
from macid.pages import ACCENT, GRID, INK, base64_of, new_figure, png, templates

_PEOPLE, _MODEL = "#8a94a0", ACCENT
_GROUPS = {
    "open": "Open scenes, replayed",
    "lab": "In corridors",
    "one way": "One way",
    "exit": "Exits",
    "two ways": "Two ways in 3.6 m",
}


def write(path: pathlib.Path, document: dict[str, Any], film: pathlib.Path | None = None) -> None:
    """Writes the page of a document of macid.human.measure.measure to the file `path`. film: a .webm file to show."""
    text = (
        templates(pathlib.Path(__file__).parent)
        .get_template("page.html")
        .render(
            document=document,
            told=_told(document),
            groups=_groups(document),
            plots=_plots(document),
            film=base64_of(film) if film else None,
            sources=sorted({f"{f['source']} ({f['licence']})" for f in figures.shipped()["files"] if "source" in f}),
        )
    )
    write_bytes(path, text.encode())


def _told(document):
    """What was measured, in clauses."""
    if "radius" not in document:
        return ["a recording, through the same code as models"]
    told = [f"radius {document['radius']:g} m", f"a decision every {document['period']:g} s"]
    told.append(f"{document['seeds']} seed{'' if document['seeds'] == 1 else 's'}")
    if document["lcf"]:
        told.append("LCF {:g} to {:g}".format(*document["lcf"]))
    if document["preferred_speed"] is not None:
        told.append(f"preferred speed {document['preferred_speed']} m/s".replace("human m/s", "as people's"))
    if document["matched"]:
        told.append("in open scenes everybody at its real one's mean speed")
    return told


def _groups(document):
    digits = {each.key: each.digits for each in figures.MEASURES}

    def told(value, key):
        return "–" if value is None else f"{value:.{digits[key]}f}"

    groups = []
    for group, title in _GROUPS.items():
        rows = []
        for key, row in document["measures"].items():
            if row["group"] == group and row["seeds"]:
                apart = None if None in row["halves"] else abs(row["halves"][0] - row["halves"][1])
                between = "" if row["interval"] is None else " to ".join(told(end, key) for end in row["interval"])
                name = row["title"] + (f" [{row['unit']}]" if row["unit"] else "")
                rows.append([name, told(row["people"], key), told(apart, key), told(row["model"], key), between])
        if rows:
            groups.append((title, rows))
    return groups


def _figure():
    """A figure and its axes."""
    figure = new_figure((6.0, 4.0))
    axes = figure.subplots()
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(colors=INK)
    return figure, axes


def _plots(document):
    """[(PNG, caption), ...]"""
    name, people, model = document["pedestrian"], document["curves"]["people"], document["curves"]["model"]
    both = [(people, "people", _PEOPLE), (model, name, _MODEL)]
    plots = []
    if "E" in model:
        figure, axes = _figure()
        for curves, label, colour in both:
            rows = np.array([row for row in curves.get("E", []) if row[1] is not None], float).reshape(-1, 2)
            axes.plot(rows[:, 0], rows[:, 1], "o-", color=colour, label=label, markersize=4)
        axes.axhline(0.0, color=INK, linewidth=0.8)
        axes.set(xlabel="time to collision [s]", ylabel="E", xlim=(0, 8))
        axes.legend(frameon=False)
        plots.append((png(figure), "Anticipation: how rare a time to collision is, beside people who don't meet"))
        figure, axes = _figure()
        for curves, label, colour in both:
            edges, share = np.array(curves["speeds"]["edges"]), np.array(curves["speeds"]["share"])
            axes.stairs(100 * share, edges, color=colour, label=label, linewidth=2, fill=label == "people", alpha=0.85)
        axes.set(xlabel="a person's mean speed [m/s]", ylabel="people [%]")
        axes.legend(frameon=False)
        plots.append((png(figure), "Speeds of people who walk, in open scenes"))
    if model.get("diagram") or people.get("diagram"):
        figure, axes = _figure()
        for curves, label, colour in both:
            rows = np.array([row for row in curves.get("diagram", []) if row[1] is not None], float).reshape(-1, 3)
            size = 4 + 40 * np.sqrt(rows[:, 2] / max(1.0, rows[:, 2].max(initial=1.0)))
            axes.scatter(rows[:, 0], rows[:, 1], s=size, color=colour, alpha=0.6, label=label, linewidths=0)
        axes.set(xlabel="density [1/m2]", ylabel="speed [m/s]", xlim=(0, 3.2), ylim=(0, 1.8))
        axes.legend(frameon=False)
        plots.append((png(figure), "Fundamental diagram, one way: mean speeds by density; larger marks, more instants"))
    keys = [key for key in document["measures"] if key.startswith(("exit", "two_speed"))]
    shown = [key for key in keys if document["measures"][key]["seeds"]]
    if shown:
        figure, axes = _figure()
        for offset, field, label, colour in ((-0.2, "people", "people", _PEOPLE), (0.2, "model", name, _MODEL)):
            values = [document["measures"][key][field] or 0.0 for key in shown]
            axes.bar(np.arange(len(shown)) + offset, values, 0.38, color=colour, label=label)
        titles = [document["measures"][key]["title"] for key in shown]
        ticks = [title.replace("flow through an ", "").replace("two ways: ", "") for title in titles]
        axes.set_xticks(np.arange(len(shown)), ticks, fontsize=8)
        axes.set(ylabel="flow [1/m/s], speed [m/s]")
        axes.legend(frameon=False)
        plots.append((png(figure), "Flows through exits, and speeds where two ways meet"))
    return plots + (_knob_plots(document["knob"]) if "knob" in document else [])


def _knob_plots(knob):
    """[(PNG, caption), ...] of what the LCF does; each seed a line."""
    plots = []
    for name, label, caption in (
        ("touch", "time touching [%]", "How much a crowd touches in which everybody has the same LCF"),
        ("way", "own share of the sidesteps", "Who gives way: two people meet, and the other one's LCF is 0"),
    ):
        figure, axes = _figure()
        for (where, rows), colour in zip(knob[name].items(), (_PEOPLE, _MODEL), strict=True):
            for number, row in enumerate(rows):
                values = [np.nan if value is None else value for value in row]
                axes.plot(knob["lcf"], values, "o-", color=colour, label=None if number else where, markersize=4)
        axes.set(xlabel="LCF", ylabel=label)
        axes.legend(frameon=False)
        plots.append((png(figure), caption))
    return plots
