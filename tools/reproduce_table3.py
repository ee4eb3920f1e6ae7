"""Table III of the paper, beside its figures, and how far robots carry over: trains and evaluates what is missing.

    tools/reproduce_table3.py --out table3

Writes OUT/table3.md (the four algorithms on the `paper` suite), carry-over-SNS.md and -Coll.md (robots trained among
one kind of pedestrian, tested among each, among one that none has met, and on `street`) and lcf.md (the score by the
LCF of everybody). Robots are trained to OUT/runs; each evaluation is kept in OUT/rows; so a stopped run goes on where
it was. Figures are means over seeds and episodes; intervals are bootstrapped over episodes, each one's mean over the
seeds of a training. With --executor ray, trainings and evaluations go side by side, on this machine's cores or on a
cluster's; all else is as without.

With --size paper the networks of SAC, TAC and BC have the paper's (1024, 1024), with one update a control step: hours
for each on a GPU (--device cuda), weeks on a few cores.

    tools/reproduce_table3.py --size paper --device cuda --algos sac tac bc --tables table3 --out table3-paper-size
"""

import argparse
import dataclasses
import hashlib
import json
import pathlib
import sys

import numpy as np

from bson.agents import load_agent
from bson.episodes.tracks import make_track
from bson.evaluation.executors import Play, play_each
from bson.evaluation.metrics import measure, summarise
from bson.evaluation.play import run_episodes
from bson.evaluation.store import basis
from bson.evaluation.suites import load_suite
from bson.learning.algorithms import on_device
from bson.learning.presets import ALGORITHMS, PRESETS
from bson.learning.train import TrainConfig, is_done, train_apart, train_with_bar
from macid import command
from macid.command import MOST_SEED, MOST_SEEDS, MOST_STEPS, Parser, add_executor, check_words
from macid.evaluate import lcf_bins
from macid.executors import make_executor
from macid.files import UsageError, output_folder, write_bytes, write_json
from macid.running import run_command

PARTS = ("SNS", "RC", "Coll", "SP", "PE")
PAPER = {
    "ppo": (50.08, 0.995, 12.95, 0.603, 0.912),
    "sac": (56.57, 0.965, 12.83, 0.657, 0.925),
    "tac": (65.14, 0.993, 8.47, 0.837, 0.942),
    "bc": (48.85, 0.992, 16.32, 0.569, 0.901),
}
PAPER["ppo-paper"] = PAPER["ppo"]
ROBOTS = (*ALGORITHMS, "ppo-paper")  # the last with all that the paper gives
_PAPER = PRESETS["paper"]
SIZES = {
    "ours": {},
    "paper": {name: dataclasses.replace(_PAPER[name], steps_per_update=1) for name in ("sac", "tac")}
    | {"bc": _PAPER["bc"]},
}
_RUNS = {"ours": "runs", "paper": "runs-paper-size"}
CROWDS = ("social-force-progress", "orca", "ipo", "macid", "macid-human")  # of the carry-over table
UNMET = "macid-touch"  # tested among, not trained among
STREET = "street"  # the suite tested on, not trained on
COLUMNS = (*CROWDS, UNMET, STREET)  # of the carry-over table
_PEOPLE = ("person_radius", "preferred_speed", "person_max_speed", "companions")  # what people are like
_LIKE_STREET = ("macid-human",)  # whose people are so as on STREET, since they learned as such
TABLES = ("table3", "lcf", "carry-over")
SCRIPTED = ("goal", "vfh", "dwa")
DEMONSTRATED = 0.2  # of the others' steps: BC's, some 1,200 episodes


def crowd_of(name):
    """The fields of the task that make the crowd `name`: the pedestrians' model, and what its people are like where
    they are not the paper's."""
    fields = {"pedestrian_model": name}
    if name in _LIKE_STREET:
        street = load_suite(STREET).cells[0].config
        fields |= {field: getattr(street, field) for field in _PEOPLE}
    return fields


def wanted(algo, crowd, seed, steps, runs, size="ours"):
    """The TrainConfig of a robot; that of BC learns from the PPO robot of the same crowd and seed. algo: with "-paper"
    behind it for that preset. size: of SIZES."""
    algo, _, preset = algo.partition("-")
    task = {} if crowd == "macid" else crowd_of(crowd)
    chosen = PRESETS[preset or "fast"][algo] if preset or algo not in SIZES[size] else SIZES[size][algo]
    if algo != "bc":
        return TrainConfig(algo, seed, steps, task, hyperparameters=chosen)
    expert = wanted("ppo", crowd, seed, steps, runs)
    chosen = dataclasses.replace(chosen, expert=str(runs / f"{expert.name}-{seed}" / "policy.npz"))
    return TrainConfig(algo, seed, int(DEMONSTRATED * steps), task, hyperparameters=chosen)


def robot(config, runs):
    """The policy file of a training, which is done first if it is missing."""
    folder = runs / f"{config.name}-{config.seed}"
    if not is_done(config, folder):
        train_with_bar(config, runs, resume=True)
    return folder / "policy.npz"


def train_missing(executor, configs, runs):
    """Trains those of `configs` that have no policy, side by side on an executor of several workers. In this process
    each is trained when it is asked for instead."""
    missing = [config for config in configs if not is_done(config, runs / f"{config.name}-{config.seed}")]
    if executor.workers is not None and missing:
        train_apart(executor, missing, runs, resume=True)


def row_of(rows, agent, suite, cell, seeds, changes):
    """The file in the folder `rows` of an evaluation of a suite's cell, the Play that makes it, and the agent's
    factory."""
    config = cell.config.replace(**changes)
    make_agent = load_agent(agent)
    track = make_agent.track, make_agent.sensor
    follows_from = basis(agent, list(track), [dataclasses.replace(cell, config=config)], False)
    follows_from["agent"] = follows_from["agent"][1] if agent.endswith(".npz") else agent  # wherever the file lies
    key = json.dumps([follows_from, suite.digest, seeds])
    path = rows / f"{hashlib.sha256(key.encode()).hexdigest()[:16]}.json"
    return path, Play(agent, config, track, tuple(seeds), agent), make_agent


def write_row(path, agent, changes, episodes):
    """Writes the metrics of Episodes to the file `path`; returns them."""
    measured = [None if e.fault else {name: measure(e)[name] for name in (*PARTS, "success")} for e in episodes]
    write_json(path, {"agent": agent, "changes": {k: str(v) for k, v in changes.items()}, "episodes": measured})
    return measured


def play_missing(executor, rows, episodes, wanted):
    """Plays what of the evaluations `wanted`, [(agent, suite, changes), ...], is not in the folder `rows`, side by side
    on an executor of several workers. In this process each is played when it is asked for instead. episodes: {suite's
    name: seeds of each cell's episodes}."""
    missing = {}
    for agent, suite, changes in wanted:
        for cell in suite.cells:
            path, play, _ = row_of(rows, agent, suite, cell, episodes[suite.name], changes)
            if not path.exists():
                missing[path] = play, changes
    plays = {id(play): (path, changes) for path, (play, changes) in missing.items()}

    def whole(play, episodes):
        path, changes = plays[id(play)]
        print(f"{play.agent} {changes or ''}", file=sys.stderr, flush=True)
        write_row(path, play.agent, changes, episodes)

    play_each(executor, [play for play, _ in missing.values()], whole)


def scored(rows, agent, suite, seeds, **changes):
    """Metrics of the suite's episodes, cell by cell the `seeds`, with the task's fields `changes`; from the folder
    `rows` if they are there."""
    measured = []
    for cell in suite.cells:
        path, play, make_agent = row_of(rows, agent, suite, cell, seeds, changes)
        if path.exists():
            measured += json.loads(path.read_text())["episodes"]
            continue
        print(f"{agent} {changes or ''} {cell.name}", file=sys.stderr, flush=True)
        episodes = run_episodes(make_agent, play.config, make_track(*play.track), seeds, agent)
        measured += write_row(path, agent, changes, episodes)
    return measured


def averaged(runs):
    """The metrics of several runs' same episodes, each the mean over the runs: [{metric: mean} or None, ...].

    None: an episode of which physics failed in any run.
    """
    episodes = zip(*runs, strict=True)
    return [
        None if None in rows else {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
        for rows in episodes
    ]


def cells(measured, names=PARTS):
    """A Markdown row's cells: means; the SNS and the collisions have their intervals, too."""
    found = summarise([row for row in measured if row])
    text = []
    for name in names:
        digits = 1 if name in ("SNS", "Coll") else 3
        mean = f"{found[name]['mean']:.{digits}f}"
        text.append(f"{mean} [{found[name]['low']:.1f}, {found[name]['high']:.1f}]" if digits == 1 else mean)
    return " | ".join(text)


def seed_means(by_seed, metric):
    """A metric's mean over each seed's episodes, as a cell's text: one number a seed."""
    return ", ".join(f"{np.mean([row[metric] for row in episodes if row]):.1f}" for episodes in by_seed)


def ship(algo, files, measured, suite, folder):
    """Copies to `folder` the robot of the algorithm `algo` that did best in validation, and notes its scores and all
    seeds'.

    files: the robots. measured: the episodes that each of them played.
    """
    measured = [[row for row in rows if row] for rows in measured]
    recipes = [json.loads(file.with_suffix(".json").read_text()) for file in files]
    seeds = [
        {
            "seed": recipe["seed"],
            "validation SNS": recipe["validation"]["SNS"],
            "SNS": round(summarise(rows)["SNS"]["mean"], 2),
        }
        for recipe, rows in zip(recipes, measured, strict=True)
    ]
    best = max(range(len(files)), key=lambda index: seeds[index]["validation SNS"])
    found = summarise(measured[best])
    scores = {name: {key: round(found[name][key], 4) for key in ("mean", "low", "high")} for name in PARTS}
    noted = {"suite": suite.name, "digest": suite.digest, **scores}
    write_bytes(folder / f"{algo}.npz", files[best].read_bytes())
    write_json(folder / f"{algo}.json", {**recipes[best], "scores": noted, "seeds": seeds})


def _table3(agents, score, note):
    """Lines of Table III; note: called with each trained algorithm, its files and the episodes of each."""
    table = ["| agent | " + " | ".join(PARTS) + " |", "|---" * (1 + len(PARTS)) + "|"]
    for name, files in agents.items():
        by_seed = [score(file) for file in files]
        several = f" ({len(files)} seeds)" if len(files) > 1 else ""
        table.append(f"| {name}{several} | {cells(averaged(by_seed))} |")
        if several:
            table.append(f"| *its seeds* | {seed_means(by_seed, 'SNS')} |" + " |" * 4)
        if name in PAPER:
            table.append("| *paper* | " + " | ".join(map(str, PAPER[name])) + " |")
            note(name, files, by_seed)
    return table


def _by_lcf(agents, score):
    """Lines of the table of the SNS by everybody's LCF."""
    bins = lcf_bins("macid")
    table = ["| agent: SNS | " + " | ".join(f"({low:.2f}, {high:.2f})" for low, high in bins) + " |"]
    table.append("|---" * (1 + len(bins)) + "|")
    for name, files in agents.items():
        by_bin = [averaged([score(file, lcf=lcf) for file in files]) for lcf in bins]
        table.append(f"| {name} | " + " | ".join(cells(measured, ("SNS",)) for measured in by_bin) + " |")
    return table


def tested_on(column):
    """(suite's name, the task's fields that differ) of a column of the carry-over table."""
    return (STREET, {}) if column == STREET else ("paper", crowd_of(column))


def _carried(robots, score, metric, columns=COLUMNS):
    """Lines of a metric's carry-over table. robots: {the crowd that robots were trained among, or an agent's name:
    files}. score: called with a file and a column. The mean is over the columns whose episodes are the same."""
    among = [column for column in columns if column != STREET]
    titles = [*among, *(["mean"] if len(among) > 1 else []), *([STREET] if STREET in columns else [])]
    table = [f"| {metric}: trained among | {' | '.join(titles)} |", "|---" * (1 + len(titles)) + "|"]
    for home, files in robots.items():
        tested = [[score(file, crowd) for file in files] for crowd in among]
        if len(among) > 1:
            tested.append([averaged(crowds) for crowds in zip(*tested, strict=True)])
        if STREET in columns:
            tested.append([score(file, STREET) for file in files])
        row = [cells(averaged(by_seed), (metric,)) for by_seed in tested]
        table.append(f"| {home} | " + " | ".join(row) + " |")
        if len(files) > 1:
            table.append("| *its seeds* | " + " | ".join(seed_means(by_seed, metric) for by_seed in tested) + " |")
    return table


def run(args):
    """Makes the tables; returns the exit code."""
    if args.ship and (args.episodes is not None or "table3" not in args.tables):
        raise UsageError("--ship notes the scores of Table III: leave --episodes out, and table3 among --tables.")
    if args.device != "cpu" and args.executor != "local":
        raise UsageError("--device is of trainings in this process: leave --executor out.")
    with on_device(args.device), make_executor(args.executor, args.ray_address, args.workers) as executor:
        return _make(args, executor)


def _make(args, executor):
    """Makes the tables on an executor."""
    suites, steps = {name: load_suite(name) for name in ("paper", STREET)}, int(args.steps)
    suite = suites["paper"]
    episodes = {"paper": suite.drawn(args.episodes)}
    share = None if args.episodes is None else max(1, args.episodes // len(suites[STREET].cells))
    episodes[STREET] = suites[STREET].drawn(share)
    out = output_folder(args.out)
    rows, runs = (
        output_folder(out / "rows"),
        output_folder(out / _RUNS[args.size]),
    )

    def configs(algo, crowd="macid"):
        return [wanted(algo, crowd, seed, steps, runs, args.size) for seed in range(args.seeds)]

    def robots(algo, crowd="macid"):
        if algo == "bc":
            robots("ppo", crowd)  # the experts
        return [str(robot(config, runs)) for config in configs(algo, crowd)]

    def score(agent, **changes):
        return scored(rows, agent, suite, episodes["paper"], **changes)

    def score_in(agent, column):
        name, changes = tested_on(column)
        return scored(rows, agent, suites[name], episodes[name], **changes)

    def note(algo, files, by_seed):
        if args.ship:
            ship(algo, [pathlib.Path(file) for file in files], by_seed, suite, output_folder(args.ship))

    def write(name, lines):
        write_bytes(out / name, ("\n".join(lines) + "\n").encode())
        print("\n".join(["", f"{out / name}:", *lines]), flush=True)

    homes = [(algo, "macid") for algo in args.algos if {"table3", "lcf"} & set(args.tables)]
    homes += [(args.carry, crowd) for crowd in args.among if "carry-over" in args.tables]
    experts = [("ppo", crowd) for algo, crowd in homes if algo == "bc"]
    for turn in (experts + [home for home in homes if home[0] != "bc"], [home for home in homes if home[0] == "bc"]):
        train_missing(executor, [config for home in dict.fromkeys(turn) for config in configs(*home)], runs)
    agents, carried, asked = {}, {}, []
    if {"table3", "lcf"} & set(args.tables):
        agents = {algo: robots(algo) for algo in args.algos} | {name: [name] for name in SCRIPTED}
        settings = [{}] if "table3" in args.tables else []
        settings += [{"lcf": lcf} for lcf in lcf_bins("macid") if "lcf" in args.tables]
        asked += [(file, suite, changes) for files in agents.values() for file in files for changes in settings]
    if "carry-over" in args.tables:
        carried = {crowd: robots(args.carry, crowd) for crowd in args.among} | {name: [name] for name in SCRIPTED}
        settings = [(suites[name], changes) for name, changes in map(tested_on, args.tested)]
        asked += [(file, *setting) for files in carried.values() for file in files for setting in settings]
    if executor.workers is not None:
        play_missing(executor, rows, episodes, asked)
    if "table3" in args.tables:
        write("table3.md", _table3(agents, score, note))
    if "lcf" in args.tables:
        write("lcf.md", _by_lcf(agents, score))
    if "carry-over" in args.tables:
        for metric in ("SNS", "Coll"):
            write(f"carry-over-{metric}.md", _carried(carried, score_in, metric, args.tested))
    return 0


def main():
    """Entry point."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algos", nargs="+", default=list(ROBOTS), choices=ROBOTS)
    parser.add_argument(
        "--carry", default="ppo", choices=list(ALGORITHMS), help="the algorithm of the carry-over table"
    )
    parser.add_argument(
        "--among",
        nargs="+",
        default=list(CROWDS),
        choices=CROWDS,
        help="only robots trained among these crowds carry over",
    )
    parser.add_argument(
        "--tested", nargs="+", default=list(COLUMNS), choices=COLUMNS, help="only these columns of the carry-over table"
    )
    parser.number("--seeds", int, 1, MOST_SEEDS, default=3, help="of each training (default 3)")
    parser.number("--steps", float, 1.0, MOST_STEPS, default=1e6, help="of each training (default 1e6)")
    parser.number("--episodes", int, -MOST_SEED, MOST_SEED, default=None, help="only the suites' first N episodes")
    parser.add_argument("--tables", nargs="+", default=list(TABLES), choices=TABLES, help="only these")
    parser.add_argument(
        "--ship", type=command.name, metavar="FOLDER", help="copy each algorithm's best robot there, with its scores"
    )
    parser.add_argument(
        "--size", default="ours", choices=list(SIZES), help="of sac's, tac's and bc's networks; paper: (1024, 1024)"
    )
    parser.add_argument(
        "--device", type=command.name, default="cpu", help="torch's, on which networks learn: cpu, cuda"
    )
    parser.add_argument("--out", type=command.name, default="table3")
    add_executor(parser)

    def read_and_run():
        check_words(sys.argv[1:])
        return run(parser.parse_args())

    return run_command("reproduce_table3", read_and_run)


if __name__ == "__main__":
    sys.exit(main())
