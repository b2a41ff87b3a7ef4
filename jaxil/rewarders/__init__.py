"""Imitation methods, one file each, behind `rewarder.Rewarder`."""
