"""Training of pedestrians by multi-agent PPO: five methods on one loop."""
