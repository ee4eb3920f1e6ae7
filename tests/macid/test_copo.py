import jax
import jax.numpy as jnp
import numpy as np
import pytest

from macid.learning import copo, ppo


def problem(number=64):
    rng = np.random.default_rng(0)
    layers = ppo.init_mlp(jax.random.key(0), (3, 4, 2), 1.0)
    old = {"layers": layers, "log_std": jnp.zeros(2)}
    data = {
        "x": jnp.asarray(rng.normal(size=(number, 3)), jnp.float32),
        "action": jnp.asarray(rng.normal(size=(number, 2)), jnp.float32),
        **{f"advantage_{name}": jnp.asarray(rng.normal(size=number), jnp.float32)
           for name in ("individual", "neighborhood", "global")},
        "lcf": jnp.asarray(0.1 * rng.normal(size=number), jnp.float32),
    }  # fmt: skip
    data["log_probability"] = ppo.log_probability(old, data["x"], data["action"])
    data["advantage"] = data["advantage_individual"]
    return old, data


def test_the_meta_gradient_is_the_change_of_the_global_objective_through_a_policy_step():
    old, data = problem()
    distribution, alpha = copo.init().distribution + jnp.array([0.2, 0.5]), 1e-2
    noise = jnp.asarray(np.random.default_rng(1).normal(size=64), jnp.float32)

    def coordinated(policy, distribution):
        mean, std = copo.moments(distribution)
        own, others = copo.quarter_turn(mean + std * noise)
        advantage = own * data["advantage_individual"] + others * data["advantage_neighborhood"]
        return jnp.mean(advantage * ppo.log_probability(policy, data["x"], data["action"]))

    def stepped(distribution):
        gradient = jax.grad(coordinated)(old, distribution)
        return jax.tree.map(lambda p, g: p + alpha * g, old, gradient)

    def global_objective(distribution):
        return ppo.clipped_objective(
            stepped(distribution), data["x"], data["action"], data["log_probability"], data["advantage_global"], 0.2
        )

    expected = [
        (global_objective(distribution + d) - global_objective(distribution - d)) / 2e-1 for d in 1e-1 * jnp.eye(2)
    ]
    weight = copo.sensitivity(old, stepped(distribution), data, 0.2)
    gradient = alpha * jax.grad(copo.meta_objective)(
        distribution, noise, weight, data["advantage_individual"], data["advantage_neighborhood"]
    )
    np.testing.assert_allclose(gradient, expected, rtol=0.05, atol=2e-6)


def test_lcfs_are_drawn_from_the_distribution():
    lcf = copo.draw(jnp.array([jnp.arctanh(0.3), jnp.log(0.2)]), jax.random.key(0), (20_000,))
    assert float(lcf.mean()) == pytest.approx(0.3, abs=0.01)
    assert float(lcf.std()) == pytest.approx(0.2, abs=0.01)


def test_the_distribution_moves_uphill():
    old, data = problem()
    meta = copo.init()
    data |= {"advantage_neighborhood": data["advantage_global"], "advantage_individual": 0 * data["advantage_global"]}
    after = copo.update(meta, old, old, data, ppo.PpoConfig(batch=32))
    assert copo.moments(after.distribution)[0] > copo.moments(meta.distribution)[0]
