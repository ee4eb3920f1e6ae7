"""Tsallis actor-critic (Lee et al. 2020): soft actor-critic with the Tsallis entropy. Only the differences from SAC are
here.

SAC's targets and losses hold log pi(a|s) = sum over the action's dimensions of ln pi(a_d|s). TAC holds ln_q in place of
ln; at q = 1 the two are the same. All else is stable-baselines3's SAC.
"""

from typing import Any

import torch
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.sac.policies import Actor, SACPolicy

EPSILON = 1e-6  # the same as in stable-baselines3's squashed Gaussian


def log_q(log_x: torch.Tensor, q: float) -> torch.Tensor:
    """ln_q x = (x^(q-1) - 1) / (q - 1) of ln x, elementwise; ln x at q = 1. For q > 1 it is at least -1 / (q - 1)."""
    return log_x if q == 1.0 else torch.expm1((q - 1.0) * log_x) / (q - 1.0)


def entropic(log_density: torch.Tensor, q: float, joint: bool) -> torch.Tensor:
    """What stands in the place of log pi(a|s): the sum of ln_q of each dimension's density, or, `joint`, ln_q of their
    product. log_density: of the action's dimensions (..., 2); returns (...)."""
    if joint:
        return log_q(log_density.sum(dim=-1), q)
    return log_q(log_density, q).sum(dim=-1)


class TsallisActor(Actor):
    """SAC's actor, whose `action_log_prob` is the sum of ln_q of its dimensions' densities, or, `joint`, ln_q of their
    product."""

    q, joint = 1.0, False

    def action_log_prob(self, obs: Any) -> tuple[torch.Tensor, torch.Tensor]:
        """Actions (N, 2) drawn for `obs` (N, features), and their ln_q pi (N,)."""
        mean, log_std, _ = self.get_action_dist_params(obs)
        drawn = self.action_dist
        assert isinstance(drawn, SquashedDiagGaussianDistribution)  # the distribution without state-dependent noise
        action = drawn.actions_from_params(mean, log_std)
        assert drawn.gaussian_actions is not None  # kept when the action was drawn
        gaussian = drawn.distribution.log_prob(drawn.gaussian_actions)
        log_density = gaussian - torch.log(1.0 - action**2 + EPSILON)
        return action, entropic(log_density, self.q, self.joint)


class TsallisPolicy(SACPolicy):
    """SAC's networks with a TsallisActor of the entropic index `q`."""

    def __init__(self, *args: Any, q: float = 1.2, joint: bool = False, **kwargs: Any):
        self._q, self._joint = q, joint  # before SACPolicy builds the networks
        super().__init__(*args, **kwargs)

    def make_actor(self, features_extractor: Any = None) -> TsallisActor:
        """The actor; called by SACPolicy."""
        kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        actor = TsallisActor(**kwargs).to(self.device)
        actor.q, actor.joint = self._q, self._joint
        return actor
