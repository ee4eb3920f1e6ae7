"""CoPO's meta step: one distribution of LCFs for everybody, moved towards the global reward (Peng et al., NeurIPS
2021).

Training makes theta_new = theta_old + alpha grad E[A(phi) log pi_old], so that the global objective of the new policy
changes with the distribution's parameters as

    < grad_theta J_global(theta_new), E[ grad_theta log pi_old . dA(phi) ] >,

with the LCF phi = mean + std * noise reparameterised. The inner product is a directional derivative of log pi_old.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from macid.geometry import Array
from macid.learning.methods import quarter_turn
from macid.learning.ppo import PpoConfig, clipped_objective, log_probability

LEARNING_RATE = 1e-4
PASSES = 5
INITIAL_STD = 0.1


class Meta(NamedTuple):
    """The distribution's parameters (2,): the LCF's mean is tanh of the first, its standard deviation exp of the
    second."""

    distribution: Any
    optimizer: Any


_optimizer = optax.adam(LEARNING_RATE)


def init() -> Meta:
    """Mean 0, standard deviation INITIAL_STD."""
    distribution = jnp.asarray([0.0, jnp.log(INITIAL_STD)], jnp.float32)
    return Meta(distribution, _optimizer.init(distribution))


def moments(distribution: Array) -> tuple[Array, Array]:
    """Mean and standard deviation of the LCF."""
    return jnp.tanh(distribution[0]), jnp.exp(distribution[1])


def draw(distribution: Array, key: Array, shape: tuple[int, ...]) -> Array:
    """LCFs of `shape`, not yet clipped to [-1, 1]."""
    mean, std = moments(distribution)
    return mean + std * jax.random.normal(key, shape)


def sensitivity(old_policy: Any, new_policy: Any, data: dict[str, Array], clip: float) -> Array:
    """< grad J_global(theta_new), grad log pi_old > of each sample (N,)."""

    def objective(policy):
        return clipped_objective(
            policy, data["x"], data["action"], data["log_probability"], data["advantage_global"], clip
        )

    direction = jax.grad(objective)(new_policy)
    along = (old_policy,), (direction,)
    return jax.jvp(lambda policy: log_probability(policy, data["x"], data["action"]), *along)[1]


def meta_objective(distribution: Array, noise: Array, weight: Array, individual: Array, neighborhood: Array) -> Array:
    """Mean of weight * (cos A_I + sin A_N) with the LCF reparameterised: to be maximised over `distribution`."""
    mean, std = moments(distribution)
    own, others = quarter_turn(mean + std * noise)
    return jnp.mean(weight * (own * individual + others * neighborhood))


def update(meta: Meta, old_policy: Any, new_policy: Any, data: dict[str, Array], config: PpoConfig) -> Meta:
    """PASSES passes over `data` in minibatches of the PPO's size."""
    mean, std = moments(meta.distribution)
    count = data["advantage"].shape[0]
    size = min(config.batch, count)
    batches = count // size
    used = {name: values[: batches * size].reshape(batches, size, *values.shape[1:]) for name, values in data.items()}
    used["noise"] = (used["lcf"] - mean) / std
    scale = jnp.std(data["advantage_global"]) + 1e-8
    used["advantage_global"] = (used["advantage_global"] - jnp.mean(data["advantage_global"])) / scale

    def step(carry, batch):
        distribution, state = carry
        weight = sensitivity(old_policy, new_policy, batch, config.clip)
        gradient = jax.grad(meta_objective)(
            distribution, batch["noise"], weight, batch["advantage_individual"], batch["advantage_neighborhood"]
        )
        change, state = _optimizer.update(-gradient, state)
        return (optax.apply_updates(distribution, change), state), None

    def one_pass(carry, _):
        return jax.lax.scan(step, carry, used)[0], None

    return Meta(*jax.lax.scan(one_pass, tuple(meta), None, length=PASSES)[0])
