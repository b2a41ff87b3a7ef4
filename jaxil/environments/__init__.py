"""Simulated environments, one or several, and playing episodes in them."""
