"""All pedestrian models beside real people: measures what is missing.

    tools/reproduce_human.py --data DIR --out human

Writes OUT/human.json (what each seed of a model has of each measure, as the model is shipped and with bodies of 0.2 m;
`matched`: open scenes in which everybody walks at its real one's mean speed; `knob`: what its LCF does) and
OUT/human.md (the main measures' means, a row a model). Each measurement is kept in OUT/rows, so a stopped run goes on
where it was. Models may be measured apart, with other numbers of seeds: `tools/make_pages.py --people OUT/human.json`
puts each one's row into the table of the pages. Without --data, flows and knob alone. With --executor ray, models are
measured side by side, on this machine's cores or on a cluster's; all else is as without.
"""

import argparse
import dataclasses
import hashlib
import json
import pathlib
import sys
from typing import NotRequired, TypedDict

import numpy as np

from macid import command
from macid.command import MOST_SEEDS, Parser, add_executor, check_words
from macid.executors import Carried, call, carry_files, make_executor
from macid.files import output_folder, write_bytes, write_json
from macid.human import data, figures
from macid.human.knob import WHERE
from macid.human.measure import Options, measure, troupe
from macid.pedestrians import check_model, is_learned, model_names
from macid.policy import load_policy
from macid.running import run_command
from macid.state import RADIUS

NARROW = 0.2  # the other radius [m]
SEEDS = 3
MATCHED = ("E0.5", "E1", "E2", "soon", "within", "straightness", "ADE", "FDE")
RANKS = ("touch_rank", "way_rank")
#: {title of the table's column: [(part of a row, measure or rank, digits), ...]}.
COLUMNS = {
    "speed, SD": [("values", "speed", 2), ("values", "speed_sd", 2)],
    "E(0.5), E(1), E(2)": [("values", key, 2) for key in ("E0.5", "E1", "E2")],
    "TTC < 2 s [%]": [("values", "soon", 1)],
    "SD within": [("values", "within", 2)],
    "straightness": [("values", "straightness", 3)],
    "smoothness": [("values", "smoothness", 2)],
    "ADE, FDE, matched": [("matched", "ADE", 2), ("matched", "FDE", 2)],
    "speed at 1.2, 2.0 /m2": [("values", "v1.2", 2), ("values", "v2", 2)],
    "exits of 1.2, 2 m": [("values", "exit1.2", 2), ("values", "exit2", 2)],
    "two ways, 18, 36: through [%]": [("values", "through18", 0), ("values", "through36", 0)],
    "speed at 36": [("values", "two_speed36", 2)],
    "LCF with touch: open, corridor": [("knob", f"touch_rank {where}", 2) for where in WHERE],
    "LCF with giving way": [("knob", f"way_rank {where}", 2) for where in WHERE],
}
LEFT_OUT = ("standing", "paper", "hz")  # nobody walks; other hyperparameters and periods


class Row(TypedDict):
    """What is known of a model. A measure has one figure for each seed, None where a seed has no value."""

    radius: float  # of its bodies [m]
    policies: list[str]
    values: dict[str, list[float | None]]  # {measure: each seed's}
    matched: NotRequired[dict[str, list[float | None]]]  # the same where everybody walks at its real one's mean speed
    knob: NotRequired[dict[str, list[float | None]]]  # {"touch_rank open": each seed's, ...}


def models():
    """The models of the tables."""
    return [name for name in model_names() if not any(part in name for part in LEFT_OUT)]


def wanted(pedestrians, folder, seeds, narrow=True):
    """{(table, pedestrian, radius): the arguments of macid.human.measure.measure}. narrow: with bodies of NARROW,
    too."""
    found = {}
    for name in pedestrians:
        many = most_seeds(name, seeds)
        for radius in (None, NARROW) if narrow and own_radius(name) != NARROW else (None,):
            options = Options(radius=radius, seeds=many)
            found["human", name, radius] = options
            if folder:
                found["matched", name, radius] = dataclasses.replace(options, matched=True, only="open")
    return {
        key: {"pedestrian": key[1], "folder": folder, "options": options, "page": False}
        for key, options in found.items()
    }


def own_radius(name):
    """The radius [m] of people of the model `name`."""
    return load_policy(name).recipe.get("radius", RADIUS) if is_learned(name) else RADIUS


def most_seeds(name, seeds):
    """`seeds`, or as many as there are policies of the method `name`."""
    while seeds > 1:
        try:
            troupe(name, seeds)
            return seeds
        except ValueError:
            seeds -= 1
    return 1


def row_file(rows, arguments, files):
    """The file of a measurement in the folder `rows`."""
    basis = [arguments["pedestrian"], dataclasses.asdict(arguments["options"]), files]
    return rows / f"{hashlib.sha256(json.dumps(basis).encode()).hexdigest()[:16]}.json"


def measure_missing(executor, asked, rows, files, carried):
    """Measures what of `asked` is not in the folder `rows`; returns {key: the document}."""
    paths = {key: row_file(rows, arguments, files) for key, arguments in asked.items()}
    missing = [key for key, path in paths.items() if not path.exists()]
    for key in missing:
        if key[1].endswith(".npz"):
            policy = pathlib.Path(key[1])
            carried += carry_files([policy, policy.with_suffix(".json")])

    def job(key):
        return None if paths[key].exists() else (measure, asked[key])

    def receive(index, document):
        table, name, radius = missing[index]
        print(f"{table}: {name}, radius {radius or 'its own'}", file=sys.stderr, flush=True)
        write_json(paths[missing[index]], document)

    executor.run(call, [lambda key=key: job(key) for key in missing], receive, carried)
    return {key: json.loads(path.read_text()) for key, path in paths.items()}


def rows_of(documents):
    """{what a table calls the model: its Row}."""
    rows = {}
    for (table, name, radius), document in documents.items():
        row = rows.setdefault(name if radius is None else f"{name}, {radius:g} m", {})
        values = {key: each["seeds"] for key, each in document["measures"].items() if each["seeds"]}
        if table == "matched":
            row["matched"] = {key: values[key] for key in MATCHED if key in values}
            continue
        row |= {"radius": document["radius"], "policies": document["policies"], "values": values}
        if "knob" in document:
            row["knob"] = {f"{rank} {where}": document["knob"][rank][where] for rank in RANKS for where in WHERE}
    return rows


def people_row():
    """The shipped figures of people, as a row of `rows_of`."""
    found = figures.shipped()["measures"]
    values = {key: [row["people"]] for key, row in found.items()}
    return {"radius": None, "values": values, "matched": {key: values[key] for key in MATCHED if key in values}}


def column(row, title, seed=None):
    """A cell of the compact table: means over seeds, or those of one `seed` (its place)."""
    told = []
    for where, key, digits in COLUMNS[title]:
        found = row.get(where, {}).get(key, [])
        own = [value for value in (found if seed is None else found[seed : seed + 1]) if value is not None]
        told.append(f"{np.mean(own):.{digits}f}" if own else "-")
    return ", ".join(told)


def lines(rows):
    """The compact Markdown table of `rows`, {what the table calls them: Row}, below a row of people."""
    shown = [f"| model | {' | '.join(COLUMNS)} |", "|---" * (1 + len(COLUMNS)) + "|"]
    for name, row in {"*people*": people_row(), **rows}.items():
        many = len(row.get("policies", ()))
        label = f"{name} ({many} seeds)" if many > 1 else name
        shown.append(f"| {label} | {' | '.join(column(row, title) for title in COLUMNS)} |")
    return shown


def run(args):
    """What the command does."""
    for name in args.pedestrians or ():
        check_model(name)
    out = output_folder(args.out)
    files = [] if args.data is None else data.files(args.data)
    digests = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]
    asked = wanted(args.pedestrians or models(), args.data, args.seeds, not args.own_radius)
    with make_executor(args.executor, args.ray_address, args.workers) as executor:
        rows = output_folder(out / "rows")
        documents = measure_missing(executor, asked, rows, digests, Carried() + carry_files(files))
    rows = rows_of(documents)
    write_json(out / "human.json", rows)
    write_bytes(out / "human.md", ("\n".join(lines(rows)) + "\n").encode())
    print(f"Written: {out / 'human.json'}, {out / 'human.md'}")
    return 0


def main():
    """Entry point."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=command.name, default=None, help="people's files (default: flows alone)")
    parser.add_argument("--pedestrians", type=command.name, nargs="+", help="models (default: all that are shipped)")
    parser.number("--seeds", int, 1, MOST_SEEDS, default=SEEDS, help=f"of each model, at most (default {SEEDS})")
    parser.add_argument("--own-radius", action="store_true", help=f"not with bodies of {NARROW:g} m, too")
    parser.add_argument("--out", type=command.name, default="human")
    add_executor(parser)

    def read_and_run():
        check_words(sys.argv[1:])
        return run(parser.parse_args())

    return run_command("reproduce_human", read_and_run)


if __name__ == "__main__":
    sys.exit(main())
