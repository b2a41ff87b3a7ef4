"""A training run: its assembly, its files, its checkpoints."""
