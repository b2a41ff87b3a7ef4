"""Simulators, files and clocks: everything that touches the machine, in NumPy."""
