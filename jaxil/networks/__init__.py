"""Floor 1: flax modules, from pixels to actions, values and logits."""
