"""Frozen sets of episodes: assets/suites/NAME.toml."""

import dataclasses
import tomllib

from bson.task import TaskConfig
from macid import assets

_SEED_STRIDE = 1_000_000  # between the episodes of --seed S and of --seed S + 1


@dataclasses.dataclass(frozen=True)
class Suite:
    """Episodes to be judged by: one configuration, and a seed an episode."""

    name: str
    description: str
    config: TaskConfig
    seeds: tuple[int, ...]

    def drawn(self, episodes=None, seed=0):
        """The seeds of the first `episodes` (default: all). seed: 0 for the frozen set, else another set of the kind.

        Raises ValueError when the suite has fewer episodes.
        """
        if episodes is not None and not 1 <= episodes <= len(self.seeds):
            raise ValueError(f"Suite '{self.name}' has 1 to {len(self.seeds)} episodes, not {episodes}.")
        if seed < 0:
            raise ValueError(f"A seed must be at least 0, not {seed}.")
        return [s + _SEED_STRIDE * seed for s in self.seeds[:episodes]]


def suite_names():
    """Names of the suites, sorted."""
    return assets.names("suites", ".toml")


def load_suite(name):
    """The suite `name`. Raises ValueError for an unknown name."""
    if name not in suite_names():
        raise ValueError(f"Unknown suite '{name}'. Choose one of {', '.join(suite_names())}.")
    fields = tomllib.loads(assets.path("suites", f"{name}.toml").read_text())
    return Suite(
        fields["name"], fields["description"], TaskConfig().replace(**fields["config"]), tuple(fields["seeds"])
    )
