"""The torch twin of `bson.guided.attended`, for stable-baselines3's policies."""

from typing import Any

import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from bson.guided import ENCODED, HIDDEN, OWN, PEOPLE, PERSON, SCANNED


class PeopleAttention(BaseFeaturesExtractor):
    """The robot's own numbers and scans, the people's mean weighed by attention, and their sum: (N, bson.guided.SIZE)
    to (N, bson.guided.ATTENDED)."""

    def __init__(self, observation_space: Any):
        super().__init__(observation_space, OWN + SCANNED + 2 * ENCODED)
        self.person = torch.nn.Sequential(
            torch.nn.Linear(OWN + PERSON, HIDDEN), torch.nn.ReLU(), torch.nn.Linear(HIDDEN, 1 + ENCODED)
        )

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """See the class."""
        rest, each = observations[..., : OWN + SCANNED], observations[..., OWN + SCANNED :]
        each = each.unflatten(-1, (PEOPLE, PERSON))
        mine = rest[..., None, :OWN].expand(*each.shape[:-1], OWN)
        encoded, present = self.person(torch.cat([mine, each], dim=-1)), each[..., :1]
        attention = present * torch.exp(10.0 * torch.tanh(encoded[..., :1] / 10.0))
        encoded = torch.relu(encoded[..., 1:])
        mean = (attention * encoded).sum(-2) / (1.0 + attention.sum(-2))
        return torch.cat([rest, mean, (present * encoded).sum(-2) / 4.0], dim=-1)
