"""The tables and cards of the pages, made from the shipped results and from the shipped policies' recipes.

    tools/make_pages.py [--rows tables/rows] [--runs RESULTS ...] [--people human/human.json ...]

Writes assets/results/*.md as far as the figures behind them are shipped, and fills the pages: between the lines
`<!-- NAME -->` and `<!-- /NAME -->` of a page stands the table or card NAME. Figures come from assets/results/*.json
(see its README.md), assets/policies/*.json and assets/agents/*.json. Nothing is played: it takes seconds. With --rows,
--runs and --people the figures in assets/results/*.json are first taken anew: from what tools/reproduce_tables.py kept,
from results that `bson evaluate` wrote, and from what tools/reproduce_human.py measured.
"""

import argparse
import json
import pathlib
import re
import sys

import numpy as np
import reproduce_human as human_tables
import reproduce_tables as tables

from bson.evaluation.metrics import summarise
from bson.evaluation.results import read_results
from bson.reporting.cards import made_by
from macid import command
from macid.command import Parser, check_words
from macid.documents import read_document
from macid.evaluate import level_name
from macid.files import UsageError, write_bytes
from macid.layout import LEVELS, OTHER_LEVELS
from macid.learning.methods import METHODS
from macid.policy import load_policy, policy_names
from macid.running import run_command
from macid.state import PHYSICS_STEP

ROOT = pathlib.Path(__file__).parents[1]
RESULTS = ROOT / "assets" / "results"
AGENTS = ROOT / "assets" / "agents"
PAGES = ("bson/README.md", "macid/README.md", "assets/policies/README.md", "assets/agents/README.md")
# Tables as their commands printed them.
GIVEN = (
    *("leaderboard", "table3", "lcf", "carry-over-SNS", "carry-over-Coll"),
    *("carry-over-human-SNS", "carry-over-human-Coll"),
)
TURNED = ("macid", "macid-touch")  # of Table I
EPISODES = 5  # a level, section and seed
DRIVEN = ("goal", "ppo", "vfh", "stop-and-go", "tac", "sac", "bc")  # of speed-and-period.md
SCORES = ("SNS", "RC", "Coll", "SP", "PE")
KEPT = ("SNS", "success", "Coll", "SP", "PE", "RC", "personal_space")  # of a robot's episodes
DIGITS = 4  # that are kept of a figure


def shipped(name):
    """What assets/results/NAME.json holds."""
    return json.loads((RESULTS / f"{name}.json").read_text())


def families():
    """{family: [name of a policy, ...]} of the shipped pedestrian policies: those that differ by the seed alone."""
    found = {}
    for name in policy_names():
        found.setdefault(name.rpartition("-")[0], []).append(name)
    return found


def rows_of(name):
    """The rows of a policy or of a rule on the four levels: [{column: mean over episodes}, ...]."""
    rules = shipped("rules")
    scores = rules[name] if name in rules else load_policy(name).recipe["scores"]
    return [scores[key] for key in (map(str, LEVELS) if name in rules else map(level_name, LEVELS))]


def labelled(name, members):
    """What a table calls a family of several seeds."""
    return f"{name} ({len(members)} seeds)"


def table2(columns=tables.COLUMNS):
    """Lines of Table II, or of the same table of other columns, without the paper's figures."""
    lines = tables.header("model", columns)
    usual = [config.name for config in tables.wanted(tables.BUDGET) if config.period == PHYSICS_STEP]
    models = dict.fromkeys(tables.RULES) | {name: families()[name] for name in usual if name in families()}
    for name, members in models.items():
        label = labelled(name, members) if members else name
        lines.append(tables.line(label, *tables.over_seeds([rows_of(m) for m in members or [name]], columns)))
        if name in tables.PAPER_TABLE_2 and columns == tables.COLUMNS:
            lines.append(tables.line("*paper*", tables.PAPER_TABLE_2[name]))
    return lines


def periods():
    """Lines of the table of times between decisions."""
    lines = tables.header("decides every")
    for suffix, period in (("", PHYSICS_STEP), *((f"-{1 / p:g}hz", p) for p in tables.PERIODS)):
        for method in ("ipo", "copo", "macid"):
            members = families()[method + suffix]
            label = f"{period:g} s, {labelled(method, members)}"
            lines.append(tables.line(label, *tables.over_seeds([rows_of(m) for m in members])))
    return lines


def table1(method):
    """Lines of Table I for a method: SR10 and CP from the knob's rows, whose episodes are the same; PE as printed."""
    knob, printed = shipped("knob"), shipped("table1-PE")[method]
    low, high = METHODS[method].lcf
    edges = np.linspace(low, high, 7)
    seeds = [knob[name] for name in families()[method]]
    lines, means = tables.header(f"{method}: LCF"), []
    for section in range(6):
        rows = [
            [{"SR10": s[str(v)]["SR10"][section], "CP": s[str(v)]["CP"][section], "PE": None} for v in LEVELS]
            for s in seeds
        ]
        mean, std = tables.over_seeds(rows)
        mean[2::3], std[2::3] = np.transpose(printed["PE"][section])
        lines.append(tables.line(f"({edges[section]:.2f}, {edges[section + 1]:.2f})", mean, std))
        means.append(mean)
        if method == "macid":
            lines.append(tables.line("*paper*", tables.PAPER_TABLE_1[section]))
    together = tables.ranks(means)
    together[2::3] = printed["PE_rank"]
    lines.append(tables.line("rank correlation of the means with the LCF", together))
    cells = []
    for level in LEVELS:
        for column in ("SR10", "CP"):
            by_seed = np.transpose([s[str(level)][column] for s in seeds])  # section, seed
            cells.append(tables.told_range(tables.ranks(by_seed)))
        cells.append("")  # each seed's PE is not shipped
    lines.append(tables.text_row("of each seed: mean and range", cells))
    return lines


def knob(figure):
    """Lines of knob.md's table of a figure (a key of reproduce_tables.KNOB)."""
    levels, rows = LEVELS + OTHER_LEVELS, shipped("knob")
    by_method = {}
    for name, of_level in rows.items():
        found = [{"pedestrian": name, **of_level[str(level)]} for level in levels]
        by_method.setdefault(name.rpartition("-")[0], []).append(found)
    return tables.knob_table(figure, by_method, levels)


def knob_means():
    """Lines of the means and ranges over seeds in knob.md's tables of SR10 and of one's own CP."""
    lines = []
    for figure, name in (("SR10", "SR10"), ("own_CP", "own CP")):
        head, rule, *rows = knob(figure)
        if not lines:
            lines += [f"| figure | {head.split(' | ', 1)[1]}", rule]
        lines += [re.sub(r"^\| \*(\S+), mean and range\*", rf"| {name}, \1", r) for r in rows if r.startswith("| *")]
    return lines


def robot_runs():
    """The shipped evaluations of robots: {(suite, overrides as text): {agent: {metric: values of 100 episodes}}}."""
    found = {}
    for run in shipped("robots"):
        settings = ",".join(f"{key}={value}" for key, value in run["overrides"].items())
        found.setdefault((run["suite"], settings), {})[run["agent"]] = run["episodes"]
    return found


def interval(values, digits=1):
    """A mean over episodes with its bootstrap 95% interval, as text; values that are None don't count."""
    found = summarise([{"": value} for value in values if value is not None])[""]
    return "{mean:.{d}f} [{low:.{d}f}, {high:.{d}f}]".format(**found, d=digits)


def speed_and_period():
    """Lines of the table of what the robot's top speed and people's time between decisions change."""
    columns = {
        "`paper`": ("paper", ""),
        "`paper-slow`: at most 1.2 m/s, 1.0 rad/s": ("paper-slow", ""),
        "people decide every 0.02 s": ("paper", "pedestrian_period=0.02"),
    }
    runs = robot_runs()
    lines = [tables.text_row("agent", columns), "|---" * (1 + len(columns)) + "|"]
    for agent in DRIVEN:
        played = [runs[key].get(agent) for key in columns.values()]
        lines.append(tables.text_row(agent, [interval(run["SNS"]) if run else "" for run in played]))
    return lines


FLOOR = ("stop", "random", "goal")  # agents that look at nothing
ORACLES = ("oracle",)  # endings of the names of agents that know everything


def mean_most(suite):
    """The most SNS of a suite, of headroom.json, over its cells."""
    return float(np.mean([cell["SNS"] for cell in suite["most"].values()]))


def board():
    """What leaderboard.md tells: {suite: {agent: {"SNS", "low", "high"}}}."""
    found = {}
    for part in re.findall(r"(?:^\|.*\n)+\nSuite `\S+`", (RESULTS / "leaderboard.md").read_text(), re.MULTILINE):
        rows = re.findall(r"^\| \d+ \| `(\S+)`.*?\| (\S+) \[(\S+), (\S+)\]", part, re.MULTILINE)
        suite = part.rpartition("`")[0].rpartition("`")[2]
        found[suite] = {agent: dict(zip(("SNS", "low", "high"), map(float, sns), strict=True)) for agent, *sns in rows}
    return found


def _standings(suite, name):
    """{agent: {"SNS", "low", "high"}, and "cells" where they are known} on a suite of headroom.json, best first."""
    found = board().get(name, {}) | suite["agents"]
    return dict(sorted(found.items(), key=lambda item: -item[1]["SNS"]))


def headroom():
    """Lines of the table of suites: the most that the metric has, the best oracle, the spread of the agents that see
    something, the floor of those that look at nothing."""
    columns = ["the metric's own most", "best oracle", "best other", "middle other", "worst other", *FLOOR]
    lines = [tables.text_row("suite", columns), "|---" * (1 + len(columns)) + "|"]
    for name, suite in shipped("headroom").items():
        standings = _standings(suite, name)
        oracles = [agent for agent in standings if agent.endswith(ORACLES)]
        others = [agent for agent in standings if agent not in (*oracles, *FLOOR)]
        cells = [f"{mean_most(suite):.1f}", _standing(standings, oracles[:1])]
        cells += [_standing(standings, others[place : place + 1]) for place in (0, len(others) // 2)]
        cells += [_standing(standings, others[-1:]), *(_standing(standings, [agent]) for agent in FLOOR)]
        lines.append(tables.text_row(f"`{name}`", cells))
    return lines


def _standing(standings, agents):
    """The first of `agents` with its SNS and interval, as text; "" where it has not played."""
    for agent in agents:
        if agent in standings:
            row = standings[agent]
            return f"`{agent}` {row['SNS']:.1f} [{row['low']:.1f}, {row['high']:.1f}]"
    return ""


def _told_apart(most, agents):
    """The cells of a suite that tables show: where no agent's figures are known, cells of the same maps are one, called
    by the grades that they share."""
    if agents:
        return most
    groups = {}
    for cell, figures in most.items():
        groups.setdefault(tuple(figures.values()), []).append(cell)
    found = {}
    for figures, cells in groups.items():
        grades = [cell.split(", ") for cell in cells]
        shared = [grade for grade in grades[0] if all(grade in each for each in grades)]
        called = f"{', '.join(shared)} ({len(cells)} cells)" if shared and len(cells) > 1 else " and ".join(cells)
        found[called] = dict(zip(next(iter(most.values())), figures, strict=True))
    return found


def headroom_cells(name):
    """Lines of the table of a suite's cells: the metric's own most, the ways that it follows from, and agents' SNS."""
    suite = shipped("headroom")[name]
    agents = [agent for agent, row in _standings(suite, name).items() if "cells" in row]
    columns = ["most SNS", "PE", "straight [m]", "shortest [m]", *(f"`{agent}`" for agent in agents)]
    lines = [tables.text_row("cell", columns), "|---" * (1 + len(columns)) + "|"]
    for cell, most in _told_apart(suite["most"], agents).items():
        cells = [f"{most['SNS']:.1f}", f"{most['PE']:.2f}", f"{most['straight']:.1f}", f"{most['shortest']:.1f}"]
        values = [suite["agents"][agent]["cells"].get(cell) for agent in agents]
        lines.append(tables.text_row(cell, cells + ["" if value is None else f"{value:.1f}" for value in values]))
    return lines


def gpu_crowds():
    """Lines of the table of crowds on a GPU."""
    cells = {}
    for row in shipped("gpu")["rows"]:
        if row["of"] == "crowd":
            for what in ("rolling out", "training"):
                if row[what]:
                    cells[row["people"], what, row["worlds"]] = f"{row[what]:,}"
    worlds = sorted({key[2] for key in cells})
    lines = [tables.text_row("people", [f"{number:,} worlds" for number in worlds]), "|---" * (1 + len(worlds)) + "|"]
    for people, what in sorted({key[:2] for key in cells}):
        lines.append(tables.text_row(f"{people}, {what}", [cells.get((people, what, number), "") for number in worlds]))
    return lines


def gpu_seeds():
    """Lines of Table II's columns for the seeds that were trained on a GPU."""
    lines = tables.header("model")
    for name, seeds in shipped("gpu-seeds").items():
        by_seed = [[levels[str(level)] for level in LEVELS] for levels in seeds.values()]
        lines.append(tables.line(labelled(name, by_seed), *tables.over_seeds(by_seed)))
    return lines


def gpu_robots():
    """Lines of the table of the robot's worlds on a GPU."""
    named = {
        "none": "none",
        "lidar2d": "2D LIDAR, 720",
        "camera": "RGB and depth, 160 x 120",
        "ppo": "PPO learning, 2D LIDAR",
    }
    lines = [tables.text_row("sensor", ["worlds", "control steps/s"]), "|---|---|---|"]
    for sensor, name in named.items():
        for row in shipped("gpu")["rows"]:
            if row["of"] == "robot" and row["sensor"] == sensor:
                lines.append(tables.text_row(name, [f"{row['worlds']:,}", f"{row['steps']:,}"]))
    return lines


def human():
    """Lines of the table of models beside real people."""
    return human_tables.lines(shipped("human"))


def human_card(family, members):
    """Lines of the card of a family that learned in scenes: how it was made, and each seed's row of `human`."""
    row, recipe = shipped("human")[family], load_policy(members[0]).recipe
    low, high = METHODS[recipe["method"]].lcf
    made = (
        f"Made by `macid train --preset human --method {recipe['method']} --agent-steps "
        f"{recipe['agent_steps_done'] / 1e6:g}e6` (each seed), in the scenes of `macid.learning.scenes`, a decision "
        f"every {recipe['period']:g} s. LCF in training: drawn from ({low:g}, {high:g})."
    )
    titles = human_tables.COLUMNS
    lines = [made, "", f"| policy | {' | '.join(titles)} |", "|---" * (1 + len(titles)) + "|"]
    for seed, name in enumerate(members):
        lines.append(f"| `{name}` | {' | '.join(human_tables.column(row, title, seed) for title in titles)} |")
    return [*lines, human_tables.lines({family: row})[-1]]


def _made(recipe):
    """How a training was made, in one line, with its command."""
    method, period = recipe["method"], recipe["period"]
    low, high = METHODS[method].lcf
    if "lcf_mean" in recipe:
        lcf = "learned with the policy"
    else:
        lcf = f"drawn from ({low:.4g}, {high:.4g})" if low < high else "0"
    words = ["macid train --method", method]
    if found := re.search(r"paper[a-z-]*?(?=-\d|$)", recipe["name"]):
        words += ["--preset", found[0]]
    if period != PHYSICS_STEP:
        words += ["--period", f"{period:g}"]
    words += ["--agent-steps", f"{recipe['agent_steps_done'] / 1e6:g}e6"]
    ppo = recipe["ppo"]
    return (
        f"Made by `{' '.join(words)}` (each seed), on Lv.{recipe['level']}, a decision every {period:g} s, "
        f"lambda {ppo['lam']:g}, batch {ppo['batch']}, {ppo['epochs']} epochs. LCF in training: {lcf}."
    )


def pedestrian_card(family, members):
    """Lines of a family's card: how it was made, and the scores of each seed and of all."""
    if METHODS[load_policy(members[0]).recipe["method"]].in_scenes:
        return human_card(family, members)
    policies = {name: load_policy(name) for name in members}
    lines = [_made(policies[members[0]].recipe), "", *tables.header("policy")]
    lines += [tables.line(f"`{name}`", *tables.over_seeds([rows_of(name)])) for name in members]
    lines.append(tables.line(labelled(family, members), *tables.over_seeds([rows_of(name) for name in members])))
    if members[0] in shipped("knob"):
        by_name = {line.split(" | ")[0].strip("| "): line.strip("| ").split(" | ") for line in knob("CP")}
        told = [f"`{name}` {by_name[name][-2]} (CP {by_name[name][-1]})" for name in members]
        lines += ["", f"Rank correlation of CP with everybody's LCF, over ten maps: {', '.join(told)}."]
    return lines


def agent_card(name):
    """Lines of a robot's policy's card: how it was made, and its scores with intervals."""
    recipe = json.loads((AGENTS / f"{name}.json").read_text())
    scores = recipe["scores"]
    lines = [
        made_by(recipe),
        "",
        tables.text_row(f"suite `{scores['suite']}`", SCORES),
        "|---" * (1 + len(SCORES)) + "|",
    ]
    cells = []
    for metric in SCORES:
        digits = 1 if metric in ("SNS", "Coll") else 3
        cells.append("{mean:.{d}f} [{low:.{d}f}, {high:.{d}f}]".format(**scores[metric], d=digits))
    lines.append(tables.text_row(f"`{name}`", cells))
    for other in recipe.get("other scores", []):
        (mean, low, high), coll = other["SNS"].values(), other["Coll"]["mean"]
        lines += ["", f"On `{other['suite']}`: SNS {mean:.1f} [{low:.1f}, {high:.1f}], {coll:.1f} collisions."]
    seeds = ", ".join(f"{seed['SNS']:.1f} (seed {seed['seed']})" for seed in recipe["seeds"])
    lines += ["", f"SNS of all seeds on that suite: {seeds}."]
    return lines


def agent_names():
    """Names of the shipped robot policies."""
    return sorted(path.stem for path in AGENTS.glob("*.npz"))


def results():
    """{name: lines} of the tables in assets/results that are made from shipped figures."""
    return {
        "table2": table2(),
        "walking": table2(tables.WALKING),
        "periods": periods(),
        "table1": [line for method in TURNED for line in ["", *table1(method)]][1:],
        "knob": [line for figure in tables.KNOB for line in ["", *knob(figure)]][1:],
        "speed-and-period": speed_and_period(),
        "human": human(),
        "gpu-crowds": gpu_crowds(),
        "gpu-robots": gpu_robots(),
        "headroom": headroom(),
        "headroom-cells": [
            line
            for name, suite in shipped("headroom").items()
            if len(suite["most"]) > 1
            for line in ("", f"Suite `{name}`:", "", *headroom_cells(name))
        ][1:],
    }


def pieces():
    """{name: lines} of everything that a page may hold between marks."""
    given = {name: (RESULTS / f"{name}.md").read_text().splitlines() for name in GIVEN}
    parts = {"knob-CP": knob("CP"), "knob-means": knob_means(), "gpu-seeds": gpu_seeds()}
    cards = {f"card-{family}": pedestrian_card(family, members) for family, members in families().items()}
    cards |= {f"card-{name}": agent_card(name) for name in agent_names()}
    return {**given, **results(), **parts, **cards}


def filled(text, parts):
    """A page's text, with what `parts` has between its marks. Raises KeyError for a mark that names nothing."""

    def fill(match):
        return f"<!-- {match[1]} -->\n" + "\n".join(parts[match[1]]) + f"\n<!-- /{match[1]} -->"

    return re.sub(r"<!-- (\S+) -->\n.*?<!-- /\1 -->", fill, text, flags=re.DOTALL)


def _rounded(value):
    return None if value is None else round(value, DIGITS)


def json_lines(content, depth):
    """JSON in which each item down to `depth` has a line of its own, so that a difference shows what changed."""
    if depth == 0 or not isinstance(content, dict) or not content:
        return json.dumps(content)
    inner = ",\n".join(f"{json.dumps(key)}: {json_lines(value, depth - 1)}" for key, value in content.items())
    return f"{{\n{inner}\n}}"


def take_rows(folder):
    """Takes the figures of knob.md and of the rules from the rows that tools/reproduce_tables.py kept in `folder`.

    Figures of policies and rules that have no row there stay. Those of the knob stay unrounded: ranks follow from them.
    """
    rows = [json.loads(path.read_text()) for path in sorted(pathlib.Path(folder).glob("*.json"))]
    if not rows:
        raise UsageError(f"There are no rows in '{folder}'. Name the folder `rows` of tools/reproduce_tables.py --out.")
    knob_rows, rules = shipped("knob"), shipped("rules")
    for row in rows:
        name, level = pathlib.Path(row["pedestrian"]).stem, str(row["level"])
        if row["episodes"] == EPISODES and "sections" in row and name in policy_names():
            knob_rows.setdefault(name, {})[level] = {figure: row[figure] for figure in tables.KNOB}
        elif row["episodes"] == EPISODES and name in tables.RULES:
            figures = (*tables.COLUMNS, *tables.WALKING)
            rules.setdefault(name, {})[level] = {figure: _rounded(row[figure]) for figure in figures}
    for name, content in (("knob", knob_rows), ("rules", rules)):
        write_bytes(RESULTS / f"{name}.json", (json_lines(content, 2) + "\n").encode())


def take_runs(sources):
    """Takes robots' episodes from the results of `bson evaluate` in `sources`, in place of earlier ones of the kind."""

    def kind(run):
        return run["suite"], json.dumps(run["overrides"]), run["agent"]

    runs = {kind(run): run for run in shipped("robots")}
    for source in sources:
        path = pathlib.Path(source)
        content = read_results(path / "results.json" if path.is_dir() else path)
        figures = {name: [_rounded(episode[name]) for episode in content["episodes"]] for name in KEPT}
        run = {key: content[key] for key in ("agent", "suite", "suite_digest", "overrides")} | {"episodes": figures}
        runs[kind(run)] = run
    texts = []
    for _, run in sorted(runs.items()):
        head = json.dumps({key: value for key, value in run.items() if key != "episodes"})
        texts.append(f'{head[:-1]}, "episodes": {json_lines(run["episodes"], 1)}}}')
    write_bytes(RESULTS / "robots.json", ("[\n" + ",\n".join(texts) + "\n]\n").encode())


def take_people(files):
    """Takes models' rows from human.json `files` that tools/reproduce_human.py wrote, in place of earlier ones of the
    name; other rows stay. Rules stand first, then methods; of each the one with bodies as shipped first."""
    rows, order = shipped("human"), [*tables.RULES, *METHODS]
    for file in files:
        rows |= read_document(file, dict[str, human_tables.Row], "models' rows")
    for name in rows:
        if name.partition(",")[0] not in order:
            raise UsageError(f"'{name}' has no row in the pages. Rows are of {', '.join(order)}.")
    rows = dict(sorted(rows.items(), key=lambda row: (order.index(row[0].partition(",")[0]), row[0])))
    write_bytes(RESULTS / "human.json", (json_lines(rows, 2) + "\n").encode())


def run(args):
    """Takes new figures, if asked to, and writes the tables and pages; returns the exit code."""
    if args.rows:
        take_rows(args.rows)
    if args.runs:
        take_runs(args.runs)
    if args.people:
        take_people(args.people)
    for name, lines in results().items():
        write_bytes(RESULTS / f"{name}.md", ("\n".join(lines) + "\n").encode())
    parts = pieces()
    for page in PAGES:
        write_bytes(ROOT / page, filled((ROOT / page).read_text(), parts).encode())
    return 0


def main():
    """Entry point."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", type=command.name, help="the folder `rows` that tools/reproduce_tables.py made")
    parser.add_argument("--runs", type=command.name, nargs="+", help="folders of bson evaluate, or their results.json")
    parser.add_argument("--people", type=command.name, nargs="+", help="human.json files of tools/reproduce_human.py")

    def read_and_run():
        check_words(sys.argv[1:])
        return run(parser.parse_args())

    return run_command("make_pages", read_and_run)


if __name__ == "__main__":
    sys.exit(main())
