"""The state of a training."""

from typing import Any, NamedTuple


class TrainState(NamedTuple):
    """The whole state that a training carries from one iteration to the next."""

    parameters: Any
    optimizer: Any
    meta: Any  #: CoPO's distribution of LCFs; None in the other methods
    walk: Any  #: of the trainer's worlds
    figures: Any  #: {name: scalar} of the last whole episode, or of the first one so far
    key: Any
    iteration: Any


#: Seeds trained at once lie along a leading axis of all but the iteration, which they share.
SEEDS = TrainState._make((0, 0, 0, 0, 0, 0, None))
