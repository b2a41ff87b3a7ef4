"""The measurements and tables of `jaxil.benchmark`."""
