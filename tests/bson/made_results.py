"""Results of `bson evaluate` on all of a suite's episodes, made up."""

import json

from bson.evaluation.suites import load_suite

OTHERS = ("success", "RC", "Coll", "SP", "PE")


def scored(folder, agent, score, suite, **changes):
    """A folder with results of `agent` on all of the episodes of `suite`, each with the same score."""
    folder.mkdir()
    suite = load_suite(suite)
    cells = [cell.name for cell in suite.cells]
    rows = [
        {"cell": cell, "seed": seed, "SNS": score} | dict.fromkeys(OTHERS, 1.0)
        for cell, seeds in zip(cells, suite.of_cells(), strict=True)
        for seed in seeds
    ]
    content = {
        "agent": agent,
        "suite": suite.name,
        "suite_digest": suite.digest,
        "overrides": {},
        "versions": {"mujoco": "3.17.0"},
        "track": ["local", "lidar2d"],
        "summary": {"SNS": score} | dict.fromkeys(OTHERS, 1.0),
        "intervals": {"SNS": [score, score]} | {name: [1.0, 1.0] for name in OTHERS},
        "cells": [{"name": cell, "grades": {"place": cell}, "config": {}} for cell in cells],
        "episodes": rows,
    }
    (folder / "results.json").write_text(json.dumps(content | changes))
    return folder
