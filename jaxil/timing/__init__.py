"""What `jaxil.benchmark` measures, and how it shows the results."""
