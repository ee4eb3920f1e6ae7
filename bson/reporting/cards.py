"""Who an agent is: a card for each, from assets/agents/cards.toml, or card.toml beside the results of one's own."""

import functools
import json
import pathlib
from typing import Annotated, Any

import msgspec

from bson.evaluation.results import Results
from bson.recurrent import UNITS
from macid import assets
from macid.documents import read_document
from macid.files import UsageError

FILE = "card.toml"  # beside results.json
_Text = Annotated[str, msgspec.Meta(min_length=1, max_length=400)]


class Card(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """What a board tells of an agent; "" where it is not known."""

    who: _Text  # what it is, and whose, where it is not this package's
    sees: _Text | None = None  # what it is given
    trained: _Text | None = None  # how, with how much, on what; "not trained"
    paper: _Text | None = None  # its source
    command: Annotated[str, msgspec.Meta(min_length=1, max_length=4000)] | None = None  # that plays it


@functools.cache
def shipped_cards() -> dict[str, Card]:
    """{agent: its Card} of the agents that come with the package."""
    return read_document(assets.path("agents", "cards.toml"), dict[str, Card], "cards")


def card_of(run: Results) -> Card | None:
    """The Card of the agent of `run`: from card.toml beside its results, or the shipped one; with what follows from the
    results and from a shipped policy's recipe where it says nothing. None for an agent without. Raises UsageError for a
    file that is no card."""
    beside = pathlib.Path(run.source)
    beside = (beside if beside.is_dir() else beside.parent) / FILE
    if beside.is_file():
        card = read_document(beside, Card, "card")
    elif (card := shipped_cards().get(run.agent)) is None:
        return None
    if shown := [text for text in msgspec.to_builtins(card).values() if not text.isprintable()]:
        raise UsageError(f"The card '{beside}' has text of more than one line: {shown[0][:60]!r}.")
    track = ", ".join(run.content.get("track") or [])
    return Card(
        card.who,
        card.sees or (f"what the track and sensors give: {track}" if track else None),
        card.trained or _trained(run.agent),
        card.paper,
        card.command or run.content.get("command"),
    )


def _trained(agent: str) -> str | None:
    """How a shipped policy was trained; None for any other agent."""
    path = assets.root() / "agents" / f"{agent}.json"
    return made_by(json.loads(path.read_text())) if path.is_file() else None


def made_by(recipe: dict[str, Any]) -> str:
    """How a policy was made, in words, from its recipe."""
    tuned = recipe["hyperparameters"]
    where = f"among 24 people of `{recipe['task'].get('pedestrian_model', 'macid')}`"
    if "draw" in recipe:
        where = f"in settings of the draw `{recipe['draw']}`"
    if "rounds" in tuned:  # imitation
        network = f"a recurrent network of {UNITS} units"
    else:
        network = f"networks of ({', '.join(map(str, tuned['hidden']))})"
    return (
        f"Made by `{recipe['command']}`: {recipe['steps_done']:,} "
        f"control steps of 0.1 s {where}; {network}. "
        f"Kept is the policy of step {recipe['from_steps']:,}, the best in {recipe['validate_episodes']} validation "
        f"episodes (SNS {recipe['validation']['SNS']:.1f})."
    )
