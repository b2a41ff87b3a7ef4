"""The encoder in C: sources, build, and its jax function."""
