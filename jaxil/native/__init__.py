"""The encoder in C: sources, compilation and jax function."""
