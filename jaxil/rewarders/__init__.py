"""Floor 2: imitation methods, one file each, behind `rewarder.Rewarder`."""
