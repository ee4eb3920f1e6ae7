"""Training of pedestrians: six methods by multi-agent PPO on one loop, and MAC-ID(human) in scenes, by gradients."""
