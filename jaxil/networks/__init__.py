"""Flax modules, from pixels to actions, values and logits."""
