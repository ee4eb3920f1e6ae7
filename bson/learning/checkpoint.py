"""Checkpoints of a robot's training, all of it but its worlds, as arrays and JSON. stable-baselines3's own save uses
pickles, which can run code when they are read."""

from typing import Annotated, Any

import msgspec
import numpy as np
import torch

from bson.learning.keeper import Count, Keeper, collect_keeper, restore_keeper, wanted_keeper
from macid.learning.curves import check_arrays

_REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")  # Adam's state for each parameter
_VARIABLES = ("log_ent_coef", "ent_coef_tensor")  # SAC's tensors beside its networks


class _Replay(msgspec.Struct):
    pos: Count
    full: bool


class _Numpy(msgspec.Struct):
    """The state of numpy.random, beside its 624 words."""

    pos: Annotated[int, msgspec.Meta(ge=0, le=624)]
    has_gauss: Annotated[int, msgspec.Meta(ge=0, le=1)]
    gauss: float


class Noted(msgspec.Struct):
    """A checkpoint's values beside its arrays."""

    steps: Count
    updates: Count
    episodes: Count
    rates: dict[str, list[float]]  #: learning rates of each optimiser
    stepped: list[str]  #: optimisers that have moments already
    replay: _Replay | None
    numpy: _Numpy
    keeper: Keeper


def collect(model: Any, keeper: dict[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """({name: array}, the values of a Noted) of a model and of its keeper's state."""
    found, rates, stepped = {}, {}, []
    for name, state in model.get_parameters().items():
        if "param_groups" not in state:
            found |= {f"{name}/{key}": tensor.cpu().numpy() for key, tensor in state.items()}
            continue
        rates[name] = [float(group["lr"]) for group in state["param_groups"]]
        if state["state"]:
            stepped.append(name)
        for index, moments in state["state"].items():
            found |= {f"{name}/{index}/{key}": moment.cpu().numpy() for key, moment in moments.items()}
    found |= {name: tensor.detach().cpu().numpy() for name, tensor in _variables(model).items()}
    replay, noted_replay = getattr(model, "replay_buffer", None), None
    rows = 0  # filled rows of the replay buffer
    if replay is not None:
        rows = len(replay.observations) if replay.full else replay.pos
        found |= {f"replay/{name}": getattr(replay, name)[:rows] for name in _REPLAY}
        noted_replay = {"pos": int(replay.pos), "full": bool(replay.full)}
    _, words, pos, has_gauss, gauss = np.random.get_state()
    found |= {"random/torch": torch.get_rng_state().numpy(), "random/numpy": words}
    arrays, noted_keeper = collect_keeper(keeper)
    return found | arrays, {
        "steps": model.num_timesteps,
        "updates": model._n_updates,
        "episodes": model._episode_num,
        "rates": rates,
        "stepped": stepped,
        "replay": noted_replay,
        "numpy": {"pos": int(pos), "has_gauss": int(has_gauss), "gauss": float(gauss)},
        "keeper": noted_keeper,
    }


def restore(model: Any, found: dict[str, np.ndarray], noted: dict[str, Any], layers: Any) -> dict[str, Any]:
    """Puts a checkpoint's arrays `found` and its values `noted` (Noted) into a new `model`; returns the keeper's state.

    layers: an example with the shapes of the policy's layers. Raises ValueError, before anything is changed, for a
    checkpoint of another model.
    """
    parameters, wanted = model.get_parameters(), {}
    for name, state in parameters.items():
        if "param_groups" not in state:
            wanted |= {f"{name}/{key}": tensor.cpu().numpy() for key, tensor in state.items()}
        elif name in noted["stepped"]:
            for index, parameter in enumerate(_owned(model, name)):
                whole = parameter.detach().cpu().numpy()
                likes = (np.zeros((), np.float32), whole, whole)
                wanted |= {f"{name}/{index}/{key}": like for key, like in zip(_MOMENTS, likes, strict=True)}
    optimizers = {name: state["param_groups"] for name, state in parameters.items() if "param_groups" in state}
    rated, grouped = ({name: len(each) for name, each in many.items()} for many in (noted["rates"], optimizers))
    if rated != grouped:
        raise ValueError("it has other optimisers")
    wanted |= {name: tensor.detach().cpu().numpy() for name, tensor in _variables(model).items()}
    replay, filled = getattr(model, "replay_buffer", None), noted["replay"]
    if (replay is None) != (filled is None):
        raise ValueError("it is of another algorithm: one has a replay buffer")
    rows = 0  # filled rows of the replay buffer
    if replay is not None:
        rows = len(replay.observations) if filled["full"] else filled["pos"]
        if not filled["pos"] < len(replay.observations):
            raise ValueError(f"its replay buffer has {filled['pos']} rows of {len(replay.observations)}")
        wanted |= {f"replay/{name}": getattr(replay, name)[:rows] for name in _REPLAY}
    wanted |= {
        "random/torch": torch.get_rng_state().numpy(),
        "random/numpy": np.random.get_state(legacy=False)["state"]["key"],
    }
    wanted |= wanted_keeper(noted["keeper"], layers)
    check_arrays(found, wanted)
    keeper = restore_keeper(found, noted["keeper"], len(layers))
    try:
        torch.set_rng_state(torch.from_numpy(found["random/torch"]))
    except RuntimeError as error:
        raise ValueError(f"its random numbers are none of torch's: {str(error).splitlines()[0]}") from None
    held = noted["numpy"]
    np.random.set_state(("MT19937", found["random/numpy"], held["pos"], held["has_gauss"], held["gauss"]))

    def tensor(name):
        return torch.from_numpy(found[name].copy())

    for name, state in parameters.items():
        if "param_groups" not in state:
            parameters[name] = {key: tensor(f"{name}/{key}") for key in state}
            continue
        moments = range(len(_owned(model, name))) if name in noted["stepped"] else ()
        parameters[name] = {
            "state": {index: {key: tensor(f"{name}/{index}/{key}") for key in _MOMENTS} for index in moments},
            "param_groups": [
                {**group, "lr": rate} for group, rate in zip(state["param_groups"], noted["rates"][name], strict=True)
            ],
        }
    model.set_parameters(parameters, exact_match=True)
    for name, variable in _variables(model).items():
        variable.data = tensor(name).to(variable.device)
    if replay is not None:
        for name in _REPLAY:
            getattr(replay, name)[:rows] = found[f"replay/{name}"]
        replay.pos, replay.full = filled["pos"], filled["full"]
    model.num_timesteps, model._n_updates, model._episode_num = noted["steps"], noted["updates"], noted["episodes"]
    return keeper


def _variables(model):
    """{name: tensor} of a model's variables beside its networks."""
    return {name: value for name in _VARIABLES if torch.is_tensor(value := getattr(model, name, None))}


def _owned(model, name) -> list[torch.nn.Parameter]:
    """The parameters of the optimiser `name` ("actor.optimizer"), in its order."""
    owner = model
    for part in name.split("."):
        owner = getattr(owner, part)
    return [parameter for group in owner.param_groups for parameter in group["params"]]
