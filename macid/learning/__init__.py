"""Training of pedestrians by multi-agent PPO: the six methods of `methods.METHODS` on one loop."""
