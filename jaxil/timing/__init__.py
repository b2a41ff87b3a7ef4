"""What `jaxil.benchmark` is made of: clocks, arithmetic, a run taken apart, tables."""
