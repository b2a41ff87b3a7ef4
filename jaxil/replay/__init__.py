"""The replay: a ring of single frames, and sampling from it."""
