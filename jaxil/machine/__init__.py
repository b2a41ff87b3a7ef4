"""The machine: start-up, devices, child processes, signals, progress."""
