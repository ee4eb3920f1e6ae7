"""Tables I and II and Fig. 2 of the paper, beside the paper's figures: trains and evaluates what is missing.

    tools/reproduce_tables.py --policies assets/policies --out tables

Writes OUT/table1.md, table2.md, periods.md (other times between decisions), walking.md (how smoothly people walk),
knob.md (how each policy's LCF works, on these and on maps of other kinds), figure2.png and figure2.csv. Policies that
are not in the folder are trained to OUT/runs; each evaluation is kept in OUT/rows; so a stopped run goes on where it
was. A method's figures are the mean over its seeds and their (sample) standard deviation. With --executor ray,
trainings and evaluations go side by side, on this machine's cores or on a cluster's; all else is as without.
"""

import argparse
import hashlib
import json
import pathlib
import sys
from dataclasses import replace

import numpy as np

from macid import command
from macid.command import MOST_SEEDS, MOST_STEPS, MOST_WORLDS, Parser, add_executor, check_words
from macid.crowd import CrowdConfig
from macid.engines import engine_kind
from macid.evaluate import TOLERATED, evaluate_level, lcf_bins, level_name, measure_knob, table_lcf, usual_period
from macid.executors import Carried, call, carry_files, make_executor
from macid.files import UsageError, output_folder, versions, write_bytes, write_json
from macid.layout import LEVELS, OTHER_LEVELS, load_level
from macid.learning.config import TrainConfig, preset
from macid.learning.curves import completed, plain
from macid.learning.methods import LEVEL_METHODS, METHODS
from macid.learning.train import train, train_apart
from macid.metrics import rank_correlation
from macid.pages import new_figure
from macid.policy import load_policy
from macid.running import run_command
from macid.state import PHYSICS_STEP

COLUMNS = ("SR10", "CP", "PE")
WALKING = ("arrived", "dv", "dw", "stalled")
PERIODS = (0.04, 0.1)  # between decisions [s], beside the usual 0.02; 0.05 is no multiple of the physics step
BUDGET = 30e6  # agent-steps of a training
SLOWER = 0.4  # of the budget at other periods, where a decision lasts longer
SEEDS, OTHERS_SEEDS = 5, 3  # of each method; of other hyperparameters and periods
AS_GIVEN = ("ipo", "macid")  # in the preset `paper`
TABLES = ("table2", "periods", "table1", "knob")  # table2: with walking.md and Fig. 2
MIXED = 2  # times as many episodes of mixed crowds, whose people are of all sections
RULES = ("social-force", "social-force-progress", "social-force-bodies", "orca")

# The paper's tables: SR10, CP, PE on Lv.1, Lv.2, Lv.3, Lv.4.
PAPER_TABLE_2 = {
    "social-force": (38.4, 13.3, 76.3, 19.2, 73.8, 77.3, 8.2, 86.5, 71.8, 2.7, 128.4, 54.4),
    "ipo": (69.6, 10.1, 93.7, 53.7, 21.0, 92.4, 34.8, 31.1, 89.2, 12.9, 75.8, 83.1),
    "mfpo": (71.3, 12.8, 93.8, 49.5, 25.9, 92.6, 29.5, 40.7, 89.6, 10.5, 90.2, 83.7),
    "copo": (69.1, 8.8, 93.9, 50.4, 20.6, 92.9, 29.8, 31.7, 89.3, 10.4, 76.1, 83.6),
    "macid-tri": (79.0, 3.4, 92.0, 68.0, 10.0, 89.9, 48.5, 12.2, 84.1, 20.3, 47.1, 76.0),
    "macid": (76.9, 5.1, 94.6, 64.5, 12.3, 92.9, 43.7, 18.6, 89.1, 17.2, 53.7, 81.4),
}
PAPER_TABLE_1 = (
    (58.7, 38.7, 93.3, 40.9, 57.9, 91.1, 19.5, 83.2, 85.3, 4.6, 157.8, 76.4),
    (67.4, 24.2, 94.2, 46.9, 40.7, 92.6, 26.5, 56.7, 88.4, 6.6, 119.8, 81.0),
    (72.6, 15.7, 94.9, 55.1, 22.4, 93.4, 31.7, 38.0, 89.8, 9.3, 90.0, 82.7),
    (75.8, 10.1, 95.3, 58.4, 16.2, 93.5, 38.8, 23.8, 89.9, 13.4, 67.3, 82.9),
    (76.0, 7.1, 94.6, 62.5, 10.4, 92.9, 43.4, 19.3, 89.1, 16.8, 55.0, 81.6),
    (76.7, 4.0, 93.7, 63.8, 8.9, 91.1, 46.3, 15.0, 86.6, 18.8, 49.7, 78.2),
)


def wanted(agent_steps, seeds=None):
    """The trainings that the tables are made of, and how many seeds of each (`seeds`, if given): {TrainConfig:
    count}."""
    usual = [TrainConfig(method=method) for method in LEVEL_METHODS]
    others = [preset(name, method="ipo") for name in ("paper-batch", "paper-ppo")]
    slower = [TrainConfig(method=method, period=period) for period in PERIODS for method in ("ipo", "copo", "macid")]
    groups = [(usual, SEEDS, 1.0), (others, OTHERS_SEEDS, 1.0), (slower, OTHERS_SEEDS, SLOWER)]
    papers = [preset("paper", method=method) for method in AS_GIVEN]  # to the paper's own budget
    share = agent_steps / BUDGET
    found = {replace(config, agent_steps=int(share * config.agent_steps)): seeds or OTHERS_SEEDS for config in papers}
    for configs, count, part in groups:
        found |= {replace(config, agent_steps=int(part * agent_steps)): seeds or count for config in configs}
    return found


def find_policies(configs, *folders):
    """{model: {seed: policy file}} of folders, read from the recipes.

    A policy that has the name of one of `configs` but was trained otherwise is named on stderr and left out: all of a
    row's seeds are to be trained alike.
    """
    configs, found = {config.name: config for config in configs}, {}
    for file in sorted(file for folder in folders for file in pathlib.Path(folder).rglob("*.npz")):
        recipe = load_policy(str(file)).recipe
        name, seed = recipe.get("name", file.stem), recipe.get("seed", 0)
        if name in configs:
            have = completed(recipe, configs[name])
            wanted = {**plain(configs[name]), "seed": seed, "engine": recipe.get("engine")}
        else:
            have = wanted = recipe
        if other := [field for field in wanted if have.get(field) != wanted[field]]:
            told = ", ".join(f"{field} is {have.get(field)}, not {wanted[field]}" for field in other)
            print(f"left out: '{file}' is no {name} of these tables: {told}", file=sys.stderr, flush=True)
            continue
        found.setdefault(name, {}).setdefault(seed, file)
    return found


def train_missing(configs, found, folder, executor=None, engine="native"):
    """Trains those of `configs`, {TrainConfig: count of seeds}, of which `found` lacks one of the first seeds: side by
    side on an executor of several workers, or seeds that follow on each other at once, with an engine that is faster
    so."""
    kind, _ = engine_kind(engine)
    todo = [
        replace(config, seed=seed, engine=engine)
        for config, seeds in configs.items()
        for seed in range(seeds)
        if seed not in found.get(config.name, {})
    ]
    if executor is not None and executor.workers is not None:
        train_apart(executor, todo, folder, resume=True, show=lambda line: print(line, file=sys.stderr, flush=True))
        return
    groups = []  # (config, how many seeds from its own on)
    for config in todo:
        before, count = groups[-1] if groups else (None, 0)
        if kind.stacks and before and replace(before, seed=before.seed + count) == config:
            groups[-1] = before, count + 1
        else:
            groups.append((config, 1))
    for number, (config, count) in enumerate(groups, start=1):
        seeds = f"seed {config.seed}" if count == 1 else f"seeds {config.seed} to {config.seed + count - 1}"
        print(f"training {number} of {len(groups)}: {config.name}, {seeds}", file=sys.stderr, flush=True)
        train(config, folder, count, resume=True, show=lambda line: print(line, file=sys.stderr, flush=True))


def evaluation(file, level, lcf, episodes):
    """(settings that a row's name follows from, the function, its arguments) of a row of `evaluate_level`; `file`: a
    policy's or a rule's name."""
    config = CrowdConfig(period=usual_period(str(file)), lcf=lcf)
    arguments = {"pedestrian": str(file), "level": level, "episodes": episodes, "config": config}
    return [plain(config), episodes], evaluate_level, arguments


def knob_evaluation(file, level, episodes):
    """As `evaluation`, of a row of `measure_knob`; `file`: a policy's."""
    config, mixed = CrowdConfig(period=usual_period(str(file))), MIXED * episodes
    arguments = {"pedestrian": str(file), "level": level, "episodes": episodes, "mixed": mixed, "config": config}
    return ["knob", plain(config), episodes, mixed], measure_knob, arguments


def evaluated(rows, file, level, lcf, episodes):
    """A row of `evaluate_level`, from the folder `rows` if it is there."""
    return kept(rows, evaluation(file, level, lcf, episodes))


def knob(rows, file, level, episodes):
    """A row of `measure_knob`, from the folder `rows` if it is there."""
    return kept(rows, knob_evaluation(file, level, episodes))


def row_file(rows, settings, arguments):
    """The file in the folder `rows` of what was played by the same model, map, `settings` and MuJoCo."""
    pedestrian, level = arguments["pedestrian"], arguments["level"]
    content = pathlib.Path(pedestrian).read_bytes() if pedestrian.endswith(".npz") else pedestrian.encode()
    layout = load_level(level)
    follows_from = [layout.obstacles.tolist(), layout.pedestrians, *settings, versions("mujoco")["mujoco"]]
    key = hashlib.sha256(content + json.dumps(follows_from).encode()).hexdigest()[:16]
    return rows / f"{pathlib.Path(pedestrian).stem}-lv{level}-{key}.json"


def kept(rows, asked):
    """The row of an `evaluation`, from the folder `rows` if it is there."""
    settings, function, arguments = asked
    path = row_file(rows, settings, arguments)
    if path.exists():
        return json.loads(path.read_text())
    print(told(asked), file=sys.stderr, flush=True)
    row = function(**arguments)
    write_json(path, row)
    return row


def told(asked):
    """An `evaluation` in words."""
    settings, _, arguments = asked
    if settings[0] == "knob":
        return f"the knob of {arguments['pedestrian']} on {level_name(arguments['level'])}"
    low, high = arguments["config"].lcf
    return f"{arguments['pedestrian']} on Lv.{arguments['level']}, LCF ({low:.2f}, {high:.2f})"


def play_missing(executor, rows, wanted):
    """Plays what of the evaluations `wanted` is not in the folder `rows`, side by side on an executor of several
    workers. In this process each is played when it is asked for instead."""
    missing = {}
    for asked in wanted:
        path = row_file(rows, asked[0], asked[2])
        if not path.exists():
            missing[path] = asked
    paths, carried = list(missing), Carried()
    for _, _, arguments in missing.values():
        if arguments["pedestrian"].endswith(".npz"):
            policy = pathlib.Path(arguments["pedestrian"])
            carried += carry_files([policy, policy.with_suffix(".json")])

    def job(path):
        return None if path.exists() else missing[path][1:]

    def receive(index, row):
        print(told(missing[paths[index]]), file=sys.stderr, flush=True)
        write_json(paths[index], {**row, "pedestrian": missing[paths[index]][2]["pedestrian"]})

    executor.run(call, [lambda path=path: job(path) for path in paths], receive, carried)


def note_scores(files, rows_by_seed):
    """Writes into the json of each of the policy `files` its scores on the levels."""
    for file, rows in zip(files, rows_by_seed, strict=True):
        scores = {
            f"Lv.{level}": {c: row[c] and round(row[c], 3) for c in (*COLUMNS, *WALKING)}
            for level, row in zip(LEVELS, rows, strict=True)
        }
        recipe = json.loads(file.with_suffix(".json").read_text())
        if recipe.get("scores") != scores:
            write_json(file.with_suffix(".json"), {**recipe, "scores": scores})


def over_seeds(rows_by_seed, columns=COLUMNS):
    """Mean over seeds of every column on every level (levels * columns,), and the standard deviation; None for a single
    seed."""
    values = np.ma.masked_invalid(
        [[row[c] if row[c] is not None else np.nan for row in rows for c in columns] for rows in rows_by_seed]
    )
    spread = values.std(axis=0, ddof=1).filled(np.nan) if len(values) > 1 else None
    return values.mean(axis=0).filled(np.nan), spread


def line(label, mean, std=None):
    """A row of a Markdown table; "-" for NaN."""
    spread = mean if std is None else std
    cells = [f"{m:.1f}" if std is None else f"{m:.1f} ± {s:.1f}" for m, s in zip(mean, spread, strict=False)]
    return text_row(label, ["-" if np.isnan(m) else cell for m, cell in zip(mean, cells, strict=False)])


def text_row(label, cells):
    """A row of a Markdown table, of texts."""
    return f"| {label} | " + " | ".join(cells) + " |"


def header(first, columns=COLUMNS):
    """The two header lines of a Markdown table."""
    names = [f"Lv.{level} {column}" for level in LEVELS for column in columns]
    return [f"| {first} | " + " | ".join(names) + " |", "|---" * (1 + len(names)) + "|"]


def ranks(values):
    """`rank_correlation` of every column of `values` (sections, columns): (columns,)."""
    return np.array([rank_correlation(column) for column in np.transpose(values)])


def told_range(values, digits=2):
    """The mean of `values` with the least and the greatest, as text; values that are NaN don't count."""
    known = np.asarray(values, float)[np.isfinite(values)]
    numbers = (known.mean(), known.min(), known.max()) if len(known) else ()
    return "{} [{}, {}]".format(*(f"{number:.{digits}f}" for number in numbers)) if numbers else "-"


KNOB = {  # of knob.md: the figure of `measure_knob`, and what it is
    "CP": "CP, everybody's LCF of one section",
    "SR10": "SR10, everybody's LCF of one section",
    "own_CP": "own CP by own LCF, in crowds of everybody's LCF",
}


def knob_table(figure, by_method, levels):
    """Lines of a table: rank correlations of a figure of KNOB with the LCF, a row a policy, a column a level.

    by_method: {method: [seed][level] rows of `measure_knob`}. The last two columns tell of the figure's mean over the
    levels: its rank correlation, and its values in the most adversarial and in the most cooperative section.
    """
    names = [*map(level_name, levels), "all maps", "first to last section"]
    lines = [text_row(KNOB[figure], names), "|---" * (1 + len(names)) + "|"]
    for method, seeds in by_method.items():
        found = []
        for rows in seeds:
            values = [[np.nan if v is None else v for v in of_level[figure]] for of_level in rows]
            values = np.array(values)  # levels, 6
            mean = values.mean(axis=0)
            found.append([*ranks(values.T), rank_correlation(mean)])
            cells = ["-" if np.isnan(r) else f"{r:.2f}" for r in found[-1]]
            name = pathlib.Path(rows[0]["pedestrian"]).stem
            lines.append(text_row(name, [*cells, f"{mean[0]:.1f} to {mean[-1]:.1f}"]))
        lines.append(text_row(f"*{method}, mean and range*", [*map(told_range, zip(*found, strict=True)), ""]))
    return lines


def plot(curves, path):
    """Fig. 2: SR_n against n, a panel a level; curves {name: (levels, TOLERATED)}."""
    figure = new_figure(figsize=(12, 3.4))
    for index, (axes, level) in enumerate(zip(figure.subplots(1, len(LEVELS)), LEVELS, strict=True)):
        for number, (name, curve) in enumerate(curves.items()):
            style = {"linewidth": 2.6} if name.startswith("macid") else {"linewidth": 1.4, "alpha": 0.85}
            style |= {"color": f"C{number % 10}", "linestyle": "-" if number < 10 else ":"}  # there are ten colours
            axes.plot(np.arange(1, TOLERATED + 1), curve[index], label=name, **style)
        axes.set_title(f"Lv.{level}")
        axes.set_xlabel("n")
        axes.set_ylim(0, 100)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("SR$_n$ [%]")
    figure.axes[-1].legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(path, dpi=130)


def run(args):
    """Makes the tables; returns the exit code."""
    with make_executor(args.executor, args.ray_address, args.workers) as executor:
        return _make(args, executor)


def _make(args, executor):
    """Makes the tables on an executor."""
    configs = wanted(args.agent_steps, args.seeds)
    engine_kind(args.engine)
    out = output_folder(args.out)
    rows, runs = output_folder(out / "rows"), output_folder(out / "runs")
    if not args.no_train:
        train_missing(configs, find_policies(configs, args.policies, runs), runs, executor, args.engine)
    policies = {
        name: list(dict(sorted(by_seed.items())).values())
        for name, by_seed in find_policies(configs, args.policies, runs).items()
    }
    if not policies:
        raise UsageError(f"No policies in '{args.policies}'. Leave --no-train out, or train some: macid train --help.")
    usual = [config.name for config in configs if config.period == PHYSICS_STEP]
    unknown = sorted(set(policies) - {config.name for config in configs})
    models = {rule: [rule] for rule in RULES} | {name: policies[name] for name in usual + unknown if name in policies}

    def tabled(name, files, lcf=None):
        """Rows of a model: [seed][level]."""
        return [
            [evaluated(rows, file, level, lcf or table_lcf(str(file)), args.episodes) for level in LEVELS]
            for file in files
        ]

    def label(name, files):
        return f"{name} ({len(files)} seed{'s' if len(files) > 1 else ''})" if name in policies else name

    def write(name, lines):
        write_bytes(out / name, ("\n".join(lines) + "\n").encode())
        print("\n".join(["", f"{out / name}:", *lines]))

    methods = {config.name: METHODS[config.method] for config in configs if config.name in usual}
    turned = [m for m in methods if m in policies and methods[m].lcf[0] < methods[m].lcf[1] and not methods[m].meta]
    if executor.workers is not None:
        play_missing(executor, rows, asked_for(args, models, policies, turned))
    if "table2" in args.tables:
        _table2(args, models, policies, tabled, label, write)
    if "periods" in args.tables:
        _periods(args, configs, policies, tabled, label, write)
    if "table1" in args.tables and turned:
        write("table1.md", _table1(turned, policies, tabled))
    if "knob" in args.tables and turned:
        levels = LEVELS + OTHER_LEVELS
        by_method = {
            m: [[knob(rows, file, level, args.episodes) for level in levels] for file in policies[m]] for m in turned
        }
        lines = [line for figure in KNOB for line in ["", *knob_table(figure, by_method, levels)]]
        write("knob.md", lines[1:])
    return 0


def asked_for(args, models, policies, turned):
    """The evaluations that the chosen tables are of."""
    chosen = {"table2": models, "periods": policies}
    groups = [group for name in chosen if name in args.tables for group in chosen[name].values()]
    files = dict.fromkeys(file for group in groups for file in group)
    asked = [evaluation(file, level, table_lcf(str(file)), args.episodes) for file in files for level in LEVELS]
    ours = [(method, file) for method in turned for file in policies[method]]
    if "table1" in args.tables:
        bins = {method: lcf_bins(str(policies[method][0])) for method in turned}
        sections = [(file, lcf) for method, file in ours for lcf in bins[method]]
        asked += [evaluation(file, level, lcf, args.episodes) for file, lcf in sections for level in LEVELS]
    if "knob" in args.tables:
        asked += [knob_evaluation(file, level, args.episodes) for _, file in ours for level in LEVELS + OTHER_LEVELS]
    return asked


def _table2(args, models, policies, tabled, label, write):
    """Writes Table II, how people walk, and Fig. 2."""
    table, walking, curves = header("model"), header("model", WALKING), {}
    for name, files in models.items():
        seeds = tabled(name, files)
        table.append(line(label(name, files), *over_seeds(seeds)))
        walking.append(line(label(name, files), *over_seeds(seeds, WALKING)))
        if name in PAPER_TABLE_2:
            table.append(line("*paper*", PAPER_TABLE_2[name]))
        curves[name] = np.mean([[row["SR"] for row in levels] for levels in seeds], axis=0)
        if args.note_scores and name in policies:
            note_scores(files, seeds)
    write("table2.md", table)
    write("walking.md", walking)
    lines = ["model,level,n,SR_n"]
    for name, curve in curves.items():
        for level, values in zip(LEVELS, curve, strict=True):
            lines += [f"{name},{level},{n},{value:.3f}" for n, value in enumerate(values, start=1)]
    write_bytes(pathlib.Path(args.out) / "figure2.csv", ("\n".join(lines) + "\n").encode())
    plot(curves, pathlib.Path(args.out) / "figure2.png")


def _periods(args, configs, policies, tabled, label, write):
    """Writes the table of times between decisions."""
    compared = [c for c in configs if c.method in ("ipo", "copo", "macid") and c.ppo == TrainConfig.ppo]
    table = header("decides every", COLUMNS)
    for config in sorted(compared, key=lambda config: config.period):
        if files := policies.get(config.name):
            name = f"{config.period:g} s, {label(config.method, files)}"
            seeds = tabled(config.name, files)
            table.append(line(name, *over_seeds(seeds)))
            if args.note_scores:
                note_scores(files, seeds)
    write("periods.md", table)


def _table1(turned, policies, tabled):
    """Lines of Table I, for each of the methods `turned`."""
    lines = []
    for method in turned:
        table, seeds = header(f"{method}: LCF"), []
        for number, lcf in enumerate(lcf_bins(str(policies[method][0]))):
            by_seed = tabled(method, policies[method], lcf)
            table.append(line(f"({lcf[0]:.2f}, {lcf[1]:.2f})", *over_seeds(by_seed)))
            seeds.append([over_seeds([levels])[0] for levels in by_seed])
            if method == "macid":
                table.append(line("*paper*", PAPER_TABLE_1[number]))
        seeds = np.array(seeds)  # section, seed, column
        table.append(line("rank correlation of the means with the LCF", ranks(np.nanmean(seeds, axis=1))))
        by_seed = [ranks(seeds[:, seed]) for seed in range(seeds.shape[1])]
        table.append(text_row("of each seed: mean and range", map(told_range, zip(*by_seed, strict=True))))
        lines += [*table, ""]
    return lines[:-1]


def main():
    """Entry point."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--policies", type=command.name, default="assets/policies", help="folder with .npz and .json files"
    )
    parser.number(
        "--seeds", int, 1, MOST_SEEDS, help=f"of each training (default: {SEEDS}, and {OTHERS_SEEDS} of other settings)"
    )
    parser.number(
        "--agent-steps",
        float,
        1.0,
        MOST_STEPS,
        default=BUDGET,
        help=f"of those (default {BUDGET:.0e}; {SLOWER:g} of it at other periods)",
    )
    parser.add_argument("--no-train", action="store_true", help="only evaluate what is there")
    parser.add_argument(
        "--engine", type=command.name, default="native", help="of trainings: native, mjx or warp, see macid.engines"
    )
    parser.number("--episodes", int, 1, MOST_WORLDS, default=5, help="a level and seed (default 5)")
    parser.add_argument("--tables", nargs="+", default=list(TABLES), choices=TABLES, help="only these")
    parser.add_argument("--note-scores", action="store_true", help="write Table II's figures into the policies' json")
    parser.add_argument("--out", type=command.name, default="tables")
    add_executor(parser)

    def read_and_run():
        check_words(sys.argv[1:])
        return run(parser.parse_args())

    return run_command("reproduce_tables", read_and_run)


if __name__ == "__main__":
    sys.exit(main())
