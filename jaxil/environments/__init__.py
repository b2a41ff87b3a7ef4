"""Simulated environments, and playing episodes in them."""
