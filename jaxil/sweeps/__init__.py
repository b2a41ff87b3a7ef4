"""Many runs: the parts of `jaxil sweep`."""
