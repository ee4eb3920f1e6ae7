"""Proximal policy optimisation with two values (paper, eqs. 2 to 4)."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import optax

from macid.geometry import Array
from macid.policy import ACTIONS, FEATURES, HIDDEN, mlp

#: What makes an output (..., out) of its layers and x: an array (..., in), or what else the network takes.
Network: TypeAlias = Callable[[Any, Any], Array]


@dataclasses.dataclass(frozen=True)
class PpoConfig:
    """Hyperparameters. What the paper gives (sec. IV-C), without annealing, scaling, clipping or standardising anything
    but the policy's ratio, is the preset `paper` of macid.learning.config; the defaults differ where that learns
    better."""

    learning_rate: float = 1e-3
    final_learning_rate: float = 5e-5  # the rate is annealed to it linearly over the training
    clip: float = 0.2  # epsilon of eq. 3
    gamma: float = 0.999
    lam: float = 0.95  # lambda of GAE
    batch: int = 2048
    epochs: int = 5
    max_gradient_norm: float | None = 0.5  # each network's gradient is clipped to it; None: not clipped
    reward_scale: float = 0.1  # inside GAE and value losses
    log_std: float = -0.5  # initial
    entropy: float = 0.0
    standardize: bool = True  # the advantages of an update, to mean 0 and standard deviation 1
    targets: str = "lambda"  # what values learn: GAE's lambda-returns, or eq. 4's returns to the end ("episode")
    arrival: str = "mean"  # what counts of the time after a goal, where a person gets a new one: see `gae`

    def __post_init__(self):
        if self.targets not in ("lambda", "episode"):
            raise ValueError(f"targets must be 'lambda' or 'episode', not '{self.targets}'.")
        if self.arrival not in ("mean", "end"):
            raise ValueError(f"arrival must be 'mean' or 'end', not '{self.arrival}'.")


def gae(
    reward: Array,
    value: Array,
    last_value: Array,
    gamma: float,
    lam: float,
    redrawn: Array | None = None,
    arrival: str = "mean",
) -> tuple[Array, Array]:
    """Generalised advantage estimates (T, ...) and returns (T, ...) of one stream without ends.

    reward, value (T, ...); last_value (...), of the state after the last step, which bootstraps it. redrawn (T, ...)
    bool: steps after which the state changes by a draw that no action influences (a new goal). The value of what
    follows such a step is replaced by its mean over all redrawn steps, so that the decisions before it get no credit
    for good or bad luck. arrival: "end" instead of "mean": an episode ends at such a step, and what follows does not
    count at all.
    """
    next_value = jnp.concatenate([value[1:], last_value[None]])
    if redrawn is None:
        redrawn = jnp.zeros(reward.shape, bool)
    typical = 0.0 if arrival == "end" else jnp.sum(next_value * redrawn) / jnp.maximum(jnp.sum(redrawn), 1)
    next_value = jnp.where(redrawn, typical, next_value)
    decay = jnp.where(redrawn, 0.0, gamma * lam)

    def backward(advantage, now):
        delta, decay = now
        advantage = delta + decay * advantage
        return advantage, advantage

    delta = reward + gamma * next_value - value
    _, advantage = jax.lax.scan(backward, jnp.zeros_like(last_value), (delta, decay), reverse=True)
    return advantage, advantage + value


def discounted_returns(reward: Array, gamma: float, ends: Array | None = None) -> Array:
    """Eq. 4's targets: the sum over t' from t to the end of gamma^(t' - t) reward (T, ...).

    ends (T, ...) bool: the steps with which an episode ends, beside the last one.
    """

    def backward(following, now):
        reward, end = now
        following = reward + jnp.where(end, 0.0, gamma * following)
        return following, following

    ends = jnp.zeros(reward.shape, bool) if ends is None else ends
    return jax.lax.scan(backward, jnp.zeros_like(reward[0]), (reward, ends), reverse=True)[1]


def init_mlp(key: Array, sizes: Sequence[int], last_scale: float) -> list[tuple[Array, Array]]:
    """Layers of a network: orthogonal weights, zero biases, the last layer's weights scaled by `last_scale`."""
    keys = jax.random.split(key, len(sizes) - 1)
    layers = []
    for index, (key, rows, columns) in enumerate(zip(keys, sizes[:-1], sizes[1:], strict=True)):
        scale = last_scale if index == len(sizes) - 2 else 2**0.5
        weight = jax.nn.initializers.orthogonal(scale)(key, (rows, columns), jnp.float32)
        layers.append((weight, jnp.zeros(columns, jnp.float32)))
    return layers


def init_parameters(
    key: Array,
    config: PpoConfig,
    critics: Sequence[str] = ("individual", "neighborhood"),
    mean_field: bool = False,
    size: int = FEATURES,
) -> dict[str, Any]:
    """The policy network and a value network for each of `critics`. Their inputs are `size` numbers and the LCF."""
    key_policy, *key_critics = jax.random.split(key, 1 + len(critics))
    seen = size + 1
    critic = seen + (size + ACTIONS if mean_field else 0)
    return {
        "policy": {
            "layers": init_mlp(key_policy, (seen, *HIDDEN, ACTIONS), 0.01),
            "log_std": jnp.full(ACTIONS, config.log_std, jnp.float32),
        },
        **{name: init_mlp(key, (critic, *HIDDEN, 1), 1.0) for name, key in zip(critics, key_critics, strict=True)},
    }


def gaussian_log_density(z: Array, log_std: Array) -> Array:
    """Log density (...) of mean + exp(log_std) z, for z (..., ACTIONS) of a diagonal Gaussian."""
    return -0.5 * jnp.sum(z**2 + jnp.log(2 * jnp.pi), axis=-1) - jnp.sum(log_std)


def log_probability(policy: Any, x: Any, action: Array, network: Network = mlp) -> Array:
    """log pi(action | x) (...) of the diagonal Gaussian policy; x (..., inputs), action (..., ACTIONS).

    network: what makes an output of its layers and x, here as in what follows."""
    log_std = policy["log_std"]
    return gaussian_log_density((action - network(policy["layers"], x)) * jnp.exp(-log_std), log_std)


def clipped_objective(
    policy: Any,
    x: Any,
    action: Array,
    old_log_probability: Array,
    advantage: Array,
    clip: float,
    network: Network = mlp,
) -> Array:
    """Eq. 3, negated: the mean of min(rho A, clip(rho) A)."""
    ratio = jnp.exp(log_probability(policy, x, action, network) - old_log_probability)
    clipped = jnp.clip(ratio, 1 - clip, 1 + clip)
    return jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))


def value_loss(layers: Any, x: Any, target: Array, network: Network = mlp) -> Array:
    """Eq. 4: mean squared error of the value (...) against the return."""
    return jnp.mean((network(layers, x)[..., 0] - target) ** 2)


def coordinated_advantage(
    individual: Array,
    neighborhood: Array,
    lcf: Array,
    coordination: Callable[[Array], tuple[Array, Array]],
    standardize: bool = True,
) -> Array:
    """Eq. 2, c_I(lcf) A_I + c_N(lcf) A_N, any shape; then, if it is to, standardised over all."""
    own, others = coordination(lcf)
    advantage = own * individual + others * neighborhood
    if not standardize:
        return advantage
    return (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8)


def make_optimizer(config: PpoConfig, updates: int, networks: Iterable[str]) -> optax.GradientTransformation:
    """Adam with each network's gradient clipped, and the learning rate annealed over `updates` minibatch steps."""
    schedule = optax.linear_schedule(config.learning_rate, config.final_learning_rate, updates)
    clip = optax.identity() if config.max_gradient_norm is None else optax.clip_by_global_norm(config.max_gradient_norm)
    one = optax.chain(clip, optax.adam(schedule, eps=1e-5))
    return optax.partition({name: one for name in networks}, {name: name for name in networks})


def loss(parameters: Any, batch: dict[str, Any], config: PpoConfig, network: Network = mlp) -> Array:
    """Sum of the networks' losses; they share no parameter, so each gets its own gradient."""
    policy, entropy = parameters["policy"], jnp.sum(parameters["policy"]["log_std"])
    objective = clipped_objective(
        policy, batch["x"], batch["action"], batch["log_probability"], batch["advantage"], config.clip, network
    )
    values = sum(
        value_loss(layers, batch["critic"], batch[f"return_{name}"], network)
        for name, layers in parameters.items()
        if name != "policy"
    )
    return values - objective - config.entropy * entropy


def update(
    parameters: Any,
    optimizer: optax.GradientTransformation,
    optimizer_state: Any,
    data: dict[str, Any],
    key: Array,
    config: PpoConfig,
    network: Network = mlp,
) -> tuple[Any, Any]:
    """`epochs` passes over `data` (a dict of arrays, or trees of them, with a leading axis (N,)) in shuffled
    minibatches."""
    count = data["advantage"].shape[0]
    batches = max(1, count // config.batch)
    size = min(config.batch, count)

    def epoch(carry, key):
        order = jax.random.permutation(key, count)[: batches * size].reshape(batches, size)

        def step(carry, index):
            parameters, state = carry
            gradient = jax.grad(loss)(parameters, jax.tree.map(lambda x: x[index], data), config, network)
            change, state = optimizer.update(gradient, state, parameters)
            return (optax.apply_updates(parameters, change), state), None

        return jax.lax.scan(step, carry, order)[0], None

    keys = jax.random.split(key, config.epochs)
    return jax.lax.scan(epoch, (parameters, optimizer_state), keys)[0]
