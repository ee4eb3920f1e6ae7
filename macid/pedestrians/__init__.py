"""Pedestrian models behind one call: `controller(state, boxes, goals, lcf) -> command`."""
