"""PPO on pieces of episodes: networks with a memory, or without one, in JAX; acting, and the update by a rollout.

A rollout of T control steps in N worlds is cut into pieces. Gradients go back through a piece, and no further
(truncated back-propagation through time). A piece begins with the memory that the robot had then, and forgets all where
an episode begins in it. Advantages, the clipped objective and the optimiser are the pedestrians' (macid.learning.ppo).
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from bson import recurrent
from macid.geometry import Array
from macid.learning import ppo
from macid.networks import relu_mlp

ACTIONS = 2


class Pieces(NamedTuple):
    """What a network is applied to: B pieces of P control steps."""

    x: Any  #: (B, P, inputs)
    began: Any  #: (B, P) bool: whether an episode began with this observation
    state: Any  #: (B, units): the memory before the first step


class Learner(NamedTuple):
    """The state of a training, beside its worlds."""

    parameters: Any  #: {"policy": {"layers", "log_std"}, "value": layers}
    optimizer: Any
    key: Any
    done: Any  #: () int32: updates so far


@dataclasses.dataclass(frozen=True)
class Mlp:
    """The network of `bson.agents.learned.Learned`: layers with ReLU between. It remembers nothing."""

    inputs: int
    hidden: tuple[int, ...]
    units = 0  #: numbers of the memory

    def init(self, key: Array, outputs: int, last_scale: float) -> Any:
        """Layers with `outputs` numbers, the last one's weights scaled by `last_scale`."""
        return ppo.init_mlp(key, (self.inputs, *self.hidden, outputs), last_scale)

    def step(self, layers: Any, x: Array, state: Array) -> tuple[Array, Array]:
        """(outputs (N, out), the memory after) of a control step in N worlds; x (N, inputs)."""
        return relu_mlp(layers, x), state

    def __call__(self, layers: Any, pieces: Any) -> Array:
        """Outputs (B, P, out)."""
        return self.step(layers, pieces.x, pieces.state)[0]


@dataclasses.dataclass(frozen=True)
class Gru:
    """The network of bson.recurrent with the `eye` of one of recurrent.EYES; inputs are what recurrent.see takes, in
    one vector."""

    eye: str
    units = recurrent.UNITS

    def init(self, key: Array, outputs: int, last_scale: float) -> Any:
        """Parts with `outputs` numbers: orthogonal weights, each gate's for itself, zero biases, the last layer's
        weights scaled by `last_scale`."""
        parts = {}
        for name, shapes in recurrent.shapes(self.eye, outputs).items():
            parts[name] = []
            for place, (rows, columns) in enumerate(shapes):
                scale = 1.0 if name == recurrent.MEMORY else 2**0.5
                if name == recurrent.HEAD and place == len(shapes) - 1:
                    scale = last_scale
                gates = 3 if name == recurrent.MEMORY else 1
                key, *each = jax.random.split(key, 1 + gates)
                draw = jax.nn.initializers.orthogonal(scale)
                blocks = [draw(one, (rows, columns // gates), jnp.float32) for one in each]
                parts[name].append((jnp.concatenate(blocks, axis=1), jnp.zeros(columns, jnp.float32)))
        return parts

    def step(self, layers: Any, x: Array, state: Array) -> tuple[Array, Array]:
        """(outputs (N, out), the memory after (N, units)) of a control step in N worlds; x (N, inputs)."""
        return recurrent.step(layers, *recurrent.parted(self.eye, x), state)

    def __call__(self, layers: Any, pieces: Any) -> Array:
        """Outputs (B, P, out)."""
        x, began, state = pieces
        flat = x.reshape(-1, x.shape[-1])
        seen = recurrent.see(layers, *recurrent.parted(self.eye, flat)).reshape(*x.shape[:2], -1)

        def remember(state, now):
            seen, began = now
            state = recurrent.remember(layers[recurrent.MEMORY], seen, jnp.where(began[:, None], 0.0, state))
            return state, state

        _, states = jax.lax.scan(remember, state, (seen.swapaxes(0, 1), began.swapaxes(0, 1)))
        return recurrent.decide(layers, states.swapaxes(0, 1))


def init(keys: Any, network: Any, log_std: float, start: Any = None) -> Any:
    """Parameters to begin with, drawn with two `keys`, the policy's and the value's. start: the layers of a policy to
    begin from; then the value's network has its eye and memory too, below a head of its own."""
    policy, value = keys
    judge = network.init(value, 1, 1.0)
    if start is not None:
        judge |= {name: start[name] for name in (recurrent.EYE, recurrent.MEMORY)}
    layers = network.init(policy, ACTIONS, 0.01) if start is None else start
    parameters = {"policy": {"layers": layers, "log_std": jnp.full(ACTIONS, log_std, jnp.float32)}, "value": judge}
    return jax.tree.map(jnp.array, parameters)  # copies, as parameters are donated


def memories(network: Any, number: int) -> dict[str, Any]:
    """The memories of policy and value in `number` worlds in which an episode begins."""
    return {name: jnp.zeros((number, network.units), jnp.float32) for name in ("policy", "value")}


def act(network: Any, parameters: Any, x: Array, began: Array, before: Any, key: Array) -> tuple[Any, Any]:
    """A control step of N robots that see x (N, inputs), in whose worlds an episode began (N,) or not: what `update`
    needs of it, {name: (N, ...)}, but "reward" and "ends"; and the memories after. before: as `memories` gives them."""
    before = jax.tree.map(lambda state: jnp.where(began[:, None], 0.0, state), before)
    log_std = parameters["policy"]["log_std"]
    mean, policy = network.step(parameters["policy"]["layers"], x, before["policy"])
    value, judge = network.step(parameters["value"], x, before["value"])
    z = jax.random.normal(key, mean.shape)
    noted = {
        "x": x,
        "began": began,
        "action": mean + jnp.exp(log_std) * z,
        "log_probability": ppo.gaussian_log_density(z, log_std),
        "value": value[..., 0],
        "memories": before,
    }
    return noted, {"policy": policy, "value": judge}


def judged(network: Any, parameters: Any, x: Array, began: Array, before: Any) -> Array:
    """The value (N,) of what robots see; as `act`."""
    state = jnp.where(began[:, None], 0.0, before["value"])
    return network.step(parameters["value"], x, state)[0][..., 0]


def cut(data: Any, piece: int) -> Any:
    """Arrays (T, N, ...) as pieces (T / piece * N, piece, ...)."""

    def one(x):
        steps, number, *rest = x.shape
        x = x.reshape(steps // piece, piece, number, *rest).swapaxes(1, 2)
        return x.reshape(steps // piece * number, piece, *rest)

    return jax.tree.map(one, data)


def update(
    learner: Learner,
    data: Any,
    last: Array,
    key: Array,
    network: Any,
    optimizer: Any,
    config: ppo.PpoConfig,
    piece: int,
    warmup: int = 0,
) -> tuple[Learner, Array]:
    """The Learner after the update by a rollout, and the share of the returns' variance that the value explained ().

    data: what `act` noted, (T, N, ...), with "reward", scaled, and "ends", bool, after which nothing counts; last: the
    value (N,) of what follows; config.batch counts pieces. In the first `warmup` updates the value alone learns.
    """
    advantage, target = ppo.gae(data["reward"], data["value"], last, config.gamma, config.lam, data["ends"], "end")
    explained = 1.0 - (target - data["value"]).var() / (target.var() + 1e-8)
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    advantage = jnp.where(learner.done < warmup, 0.0, advantage)  # so the policy has no gradient
    whole = {name: data[name] for name in ("x", "began", "action", "log_probability", "memories")}
    pieces = cut(whole | {"advantage": advantage, "target": target}, piece)
    states = jax.tree.map(lambda state: state[:, 0], pieces["memories"])
    batch = {
        "x": Pieces(pieces["x"], pieces["began"], states["policy"]),
        "critic": Pieces(pieces["x"], pieces["began"], states["value"]),
        "action": pieces["action"],
        "log_probability": pieces["log_probability"],
        "advantage": pieces["advantage"],
        "return_value": pieces["target"],
    }
    parameters, state = ppo.update(learner.parameters, optimizer, learner.optimizer, batch, key, config, network)
    return Learner(parameters, state, learner.key, learner.done + 1), explained


def leaves(learner: Learner) -> dict[str, np.ndarray]:
    """A Learner as arrays, {name: array}."""
    return {f"learner/{place}": np.asarray(leaf) for place, leaf in enumerate(jax.tree.leaves(learner))}


def of_leaves(learner: Learner, found: Any) -> Learner:
    """The Learner of what `leaves` gave; learner: one of the same shapes."""
    tree = jax.tree.structure(learner)
    return jax.tree.unflatten(tree, [jnp.asarray(found[f"learner/{place}"]) for place in range(tree.num_leaves)])
