"""All pedestrian models beside real people: measures what is missing.

    tools/reproduce_human.py --data DIR --out human

Writes OUT/human.md (a row a model, as it is shipped and with bodies of 0.2 m) and OUT/matched.md (open scenes in which
everybody walks at its real one's mean speed). Each measurement is kept in OUT/rows, so a stopped run goes on where it
was. Without --data, flows alone. With --executor ray, models are measured side by side, on this machine's cores or on a
cluster's; all else is as without.
"""

import argparse
import dataclasses
import hashlib
import json
import pathlib
import sys

from macid import command
from macid.command import MOST_SEEDS, Parser, add_executor, check_words
from macid.executors import Carried, call, carry_files, make_executor
from macid.files import output_folder, run_command, write_bytes, write_json
from macid.human import data, figures
from macid.human.measure import Options, measure, troupe
from macid.pedestrians import check_model, model_names

NARROW = 0.2  # the other radius [m]
SEEDS = 3
MATCHED = ("E0.5", "E1", "E2", "soon", "within", "straightness", "ADE", "FDE")
LEFT_OUT = ("standing", "paper", "hz")  # nobody walks; other hyperparameters and periods


def models():
    """The models of the tables."""
    return [name for name in model_names() if not any(part in name for part in LEFT_OUT)]


def wanted(pedestrians, folder, seeds):
    """{(table, pedestrian, radius): the arguments of macid.human.measure.measure}."""
    found = {}
    for name in pedestrians:
        many = most_seeds(name, seeds)
        for radius in (None, NARROW):
            options = Options(radius=radius, seeds=many, only=None if folder else "flows")
            found["human", name, radius] = options
            if folder:
                found["matched", name, radius] = dataclasses.replace(options, matched=True, only="open")
    return {
        key: {"pedestrian": key[1], "folder": folder, "options": options, "page": False}
        for key, options in found.items()
    }


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


def cell(row, digits):
    """A measure's mean with the half width of its interval."""
    if row["model"] is None:
        return "-"
    if row["interval"] is None:
        return f"{row['model']:.{digits}f}"
    return f"{row['model']:.{digits}f} ± {(row['interval'][1] - row['interval'][0]) / 2:.{digits}f}"


def lines(documents, table, keys):
    """A Markdown table of the measures `keys`: people, then a row a model and radius."""
    shown = [each for each in figures.MEASURES if each.key in keys]
    rows = [f"| model | seeds | radius [m] | {' | '.join(each.key for each in shown)} |", "|---" * (3 + len(shown)) + "|"]
    people = next(iter(documents.values()))["measures"]
    told = ["-" if people[m.key]["people"] is None else f"{people[m.key]['people']:.{m.digits}f}" for m in shown]
    rows.append(f"| people | | | {' | '.join(told)} |")
    for (kind, name, _), document in documents.items():
        if kind == table:
            cells = [cell(document["measures"][each.key], each.digits) for each in shown]
            rows.append(f"| {name} | {document['seeds']} | {document['radius']:g} | {' | '.join(cells)} |")
    return rows


def run(args):
    """What the command does."""
    for name in args.pedestrians or ():
        check_model(name)
    out = output_folder(args.out)
    files = [] if args.data is None else data.files(args.data)
    digests = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]
    asked = wanted(args.pedestrians or models(), args.data, args.seeds)
    with make_executor(args.executor, args.ray_address, args.workers) as executor:
        rows = output_folder(out / "rows")
        documents = measure_missing(executor, asked, rows, digests, Carried() + carry_files(files))
    keys = [each.key for each in figures.MEASURES]
    write_bytes(out / "human.md", ("\n".join(lines(documents, "human", keys)) + "\n").encode())
    print(f"Written: {out / 'human.md'}")
    if args.data:
        write_bytes(out / "matched.md", ("\n".join(lines(documents, "matched", MATCHED)) + "\n").encode())
        print(f"Written: {out / 'matched.md'}")
    return 0


def main():
    """Entry point."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=command.name, default=None, help="people's files (default: flows alone)")
    parser.add_argument("--pedestrians", type=command.name, nargs="+", help="models (default: all that are shipped)")
    parser.number("--seeds", int, 1, MOST_SEEDS, default=SEEDS, help=f"of each model, at most (default {SEEDS})")
    parser.add_argument("--out", type=command.name, default="human")
    add_executor(parser)

    def read_and_run():
        check_words(sys.argv[1:])
        return run(parser.parse_args())

    return run_command("reproduce_human", read_and_run)


if __name__ == "__main__":
    sys.exit(main())
