"""Many worlds at once: their scene, physics by an engine, people's decisions, sensors, and the count of contacts."""
