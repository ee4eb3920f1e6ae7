"""Ships a robot's policy with its scores: assets/agents/NAME.npz and NAME.json, of which tools/make_pages.py makes its
card.

    bson evaluate --agent runs/bc-gru-standard-0/policy.npz --suite paper --out scored/paper
    tools/ship_agent.py gru runs/bc-gru-standard-0/policy.npz scored/paper scored/standard

The first results are those of the suite `paper`; the others are told beside them.
"""

import json
import pathlib
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


def ship(args):
    """Writes both files; returns the exit code."""
    policy = pathlib.Path(args.policy)
    load_agent(args.policy)  # refuses what is none
    first, *others = map(noted, args.results)
    if first["suite"] != "paper":
        raise UsageError(f"The first results must be those of the suite 'paper', not '{first['suite']}'.")
    recipe = json.loads(policy.with_suffix(".json").read_text())
    seed = {
        "seed": recipe["seed"],
        "validation SNS": recipe["validation"]["SNS"],
        "SNS": round(first["SNS"]["mean"], 2),
    }
    recipe |= {"scores": first, "seeds": [seed], **({"other scores": others} if others else {})}
    write_bytes(AGENTS / f"{args.name}.npz", policy.read_bytes())
    write_json(AGENTS / f"{args.name}.json", recipe)
    return 0


def main():
    """Entry point."""
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("name", type=command.name)
    parser.add_argument("policy", type=command.name)
    parser.add_argument("results", type=command.name, nargs="+", metavar="FOLDER")

    def read_and_run():
        check_words(sys.argv[1:])
        return ship(parser.parse_args())

    return run_command("ship_agent", read_and_run)


if __name__ == "__main__":
    sys.exit(main())
