"""Pure functions on arrays. No networks, no files, no clocks."""
