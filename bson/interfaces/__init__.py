"""The benchmark behind common interfaces: Gymnasium environments, JAX functions, MJCF files."""
