"""Readers of pixel demonstrations, one module per format."""
