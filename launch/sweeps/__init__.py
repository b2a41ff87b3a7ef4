"""Many runs: the parts of `launch/sweep.py`."""
