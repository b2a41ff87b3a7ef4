"""Other people's demonstration files, one module for each format."""
