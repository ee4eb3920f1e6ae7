"""The benchmark through the interfaces of others."""
