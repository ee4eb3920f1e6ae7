"""The benchmark for Python: the commands `bson evaluate`, `compare`, `leaderboard`, `verify`, `render`, `live`,
`record`, `replay`, `ros`, `deploy`, `dataset` and `train` as calls.

    from bson import benchmark

    results = benchmark.evaluate(agent, "smoke", out="results/mine")
    results.metrics["SNS"]  # (episodes,), see bson.evaluation.results.Results

Errors that a user can mend are ValueErrors of one line, most of them macid.files.UsageError. Heavy modules are loaded
when they are needed: comparing results loads neither JAX nor MuJoCo.
"""

from bson.benchmark.bags import record, replay
from bson.benchmark.datasets import dataset
from bson.benchmark.driving import live
from bson.benchmark.films import film
from bson.benchmark.scoring import evaluate
from bson.benchmark.tables import compare, heatmap, leaderboard
from bson.benchmark.training import train, train_configs
from bson.benchmark.wire import deploy, ros
from bson.evaluation.results import Results
from bson.evaluation.verify import verify

__all__ = [
    "Results",
    "compare",
    "dataset",
    "deploy",
    "evaluate",
    "film",
    "heatmap",
    "leaderboard",
    "live",
    "record",
    "replay",
    "ros",
    "train",
    "train_configs",
    "verify",
]
