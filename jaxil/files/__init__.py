"""File formats: archives, tables, videos."""
