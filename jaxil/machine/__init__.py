"""The machine: start-up, caches, signals, progress."""
