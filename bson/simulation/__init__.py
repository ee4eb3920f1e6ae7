"""Worlds of pedestrians and a robot, and the engines that move them."""
