"""Floor 0: pure functions on arrays. No networks, no files, no clocks."""
