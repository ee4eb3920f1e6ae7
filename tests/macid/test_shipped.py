"""The shipped policies: each is what its name says."""

import pytest

from macid.learning.config import PRESETS, preset
from macid.learning.curves import completed, plain
from macid.learning.methods import get_method
from macid.policy import load_policy, policy_names


@pytest.mark.parametrize("name", policy_names())
def test_a_policy_has_the_name_of_its_method_preset_and_period(name):
    recipe = load_policy(name).recipe
    in_scenes = get_method(recipe["method"]).in_scenes
    presets = [each for each in PRESETS if ("scenes" in PRESETS[each]) == in_scenes]
    have = completed(recipe, preset(presets[0], method=recipe["method"]))
    fields = {field: have[field] for field in ("method", "level", "seed", "engine", "nworld", "period", "agent_steps")}
    of_this_recipe = [
        config.name
        for config in (preset(each, **fields) for each in presets)
        if all(have[field] == value for field, value in plain(config).items())
    ]
    assert of_this_recipe == [recipe["name"]] and name == f"{recipe['name']}-{recipe['seed']}"
