"""Many worlds at once: their scene, physics behind an engine, people who decide, contacts that are counted."""
