"""Imitation learning from pixel observations, in JAX."""
