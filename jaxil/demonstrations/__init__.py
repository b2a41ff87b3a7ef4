"""Demonstrations: reading, rendering, checking and inspecting them."""
