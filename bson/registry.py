"""Every kind of name that users of the benchmark give, in one table. Each Kind (macid.registry) is defined beside the
things that it names."""

import importlib

from macid.registry import Kind

#: {the name of its list: (where its Kind is, how users give such a name)}
KINDS = {
    "agents": ("bson.agents:AGENTS", "--agent NAME"),
    "pedestrians": ("macid.pedestrians:PEDESTRIANS", "--set pedestrian_model=NAME"),
    "tracks": ("bson.episodes.tracks:TRACK_KIND", "--track NAME"),
    "sensors": ("bson.episodes.tracks:SENSOR_KIND", "--sensor NAME"),
    "maps": ("macid.maps:MAPS", "--set map=NAME"),
    "robots": ("bson.robot:ROBOTS", "--set robot=NAME"),
    "suites": ("bson.evaluation.suites:SUITES", "--suite NAME"),
    "metrics": ("bson.evaluation.metrics:METRIC_KIND", "--metric NAME"),
    "planners": ("bson.planners.planning:KIND", "bson.planners.plan(NAME, ...)"),
    "algorithms": ("bson.learning.presets:KIND", "bson train --algo NAME"),
    "methods": ("macid.learning.methods:KIND", "macid train --method NAME"),
}


def kind(what: str) -> Kind:
    """The Kind in KINDS under the name `what`. Raises ModuleNotFoundError where it needs an extra that is missing."""
    module, _, attribute = KINDS[what][0].partition(":")
    return getattr(importlib.import_module(module), attribute)
