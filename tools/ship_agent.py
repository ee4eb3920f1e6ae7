r"""Ships a robot's policy with its scores: assets/agents/NAME.npz and NAME.json, of which tools/make_pages.py makes its
card.

    bson evaluate --agent runs/bc-gru-standard-0/policy.npz --suite paper --out scored/paper
    tools/ship_agent.py gru runs/bc-gru-standard-0/policy.npz scored/paper scored/standard \
        --seed runs/bc-gru-standard-1/policy.npz scored/paper-1

The first results are those of the suite `paper`; the others are told beside them. --seed: another seed of the same
training, and its results on `paper`.
"""

import json
import pathlib
import re
import sys

from bson.agents import load_agent
from bson.evaluation.results import read_results
from bson.evaluation.suites import load_suite
from macid import command
from macid.command import Parser, check_words
from macid.files import UsageError, write_bytes, write_json
from macid.running import run_command

AGENTS = pathlib.Path(__file__).parents[1] / "assets" / "agents"
SCORES = ("SNS", "RC", "Coll", "SP", "PE")


def noted(folder):
    """The scores of the results in `folder`, as a recipe has them."""
    found = read_results(pathlib.Path(folder) / "results.json")
    scores = {
        name: dict(zip(("mean", "low", "high"), (found["summary"][name], *found["intervals"][name]), strict=True))
        for name in SCORES
    }
    rounded = {name: {key: round(value, 4) for key, value in each.items()} for name, each in scores.items()}
    return {"suite": found["suite"], "digest": load_suite(found["suite"]).digest, **rounded}


def trained(policy):
    """The recipe of `policy`, a .npz file."""
    load_agent(policy)  # refuses what is none
    recipe = json.loads(pathlib.Path(policy).with_suffix(".json").read_text())
    if "command" not in recipe:
        raise UsageError(f"The recipe of '{policy}' has no command: it was trained by an earlier version.")
    return recipe


def but_for_seed(recipe):
    """A recipe's command without its seed."""
    return re.sub(r" --seed \d+", "", recipe["command"])


def seed_of(recipe, scores):
    """What a recipe tells of one of its training's seeds."""
    if scores["suite"] != "paper":
        raise UsageError(f"The first results, and those of --seed, are of the suite 'paper', not '{scores['suite']}'.")
    mean = round(scores["SNS"]["mean"], 2)
    return {"seed": recipe["seed"], "validation SNS": recipe["validation"]["SNS"], "SNS": mean}


def ship(args):
    """Writes both files; returns the exit code."""
    recipe = trained(args.policy)
    first, *others = map(noted, args.results)
    seeds = [seed_of(recipe, first)]
    for policy, results in args.seed:
        other = trained(policy)
        if but_for_seed(other) != but_for_seed(recipe):
            raise UsageError(f"'{policy}' is no other seed of the training `{recipe['command']}`: {other['command']}.")
        seeds.append(seed_of(other, noted(results)))
    seeds.sort(key=lambda seed: seed["seed"])
    if len({seed["seed"] for seed in seeds}) < len(seeds):
        raise UsageError(f"The seeds must differ, not be {', '.join(str(seed['seed']) for seed in seeds)}.")
    recipe |= {"scores": first, "seeds": seeds, **({"other scores": others} if others else {})}
    write_bytes(AGENTS / f"{args.name}.npz", pathlib.Path(args.policy).read_bytes())
    write_json(AGENTS / f"{args.name}.json", recipe)
    return 0


def main():
    """Entry point."""
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("name", type=command.name)
    parser.add_argument("policy", type=command.name)
    parser.add_argument("results", type=command.name, nargs="+", metavar="FOLDER")
    parser.add_argument(
        "--seed",
        type=command.name,
        nargs=2,
        action="append",
        default=[],
        metavar=("POLICY", "FOLDER"),
        help="another",
    )

    def read_and_run():
        check_words(sys.argv[1:])
        return ship(parser.parse_args())

    return run_command("ship_agent", read_and_run)


if __name__ == "__main__":
    sys.exit(main())
