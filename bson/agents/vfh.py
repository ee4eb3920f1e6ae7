"""A reactive avoider on the 2D LIDAR, of the vector field histogram kind (VFH+, Ulrich and Borenstein 1998)."""

import numpy as np


class Vfh:
    """Placeholder to be replaced."""

    def __call__(self, observation):
        scan = observation["lidar"].astype(float)
        n = len(scan)
        angles = np.linspace(-np.deg2rad(135), np.deg2rad(135), n)
        x, y = observation["goal"]
        bearing = np.arctan2(y, x)
        near = scan < 4.0
        half = np.arcsin(np.clip(0.65 / np.maximum(scan, 0.66), 0, 1))
        candidates = np.linspace(-2.2, 2.2, 89)
        clear = np.full(len(candidates), 4.0)
        if near.any():
            delta = np.abs(candidates[:, None] - angles[near][None])
            hit = delta <= half[near][None]
            clear = np.where(hit, scan[near][None], 4.0).min(axis=1)
        cost = np.abs(candidates - bearing) + 2.0 * (4.0 - clear)
        best = int(np.argmin(cost))
        turn = candidates[best]
        ahead = clear[np.abs(candidates) < 0.3].min()
        speed = np.clip((ahead - 0.5) / 1.5, 0.0, 1.0) * max(0.0, np.cos(turn))
        return np.array([0.85 * speed, np.clip(turn, -1, 1)])
