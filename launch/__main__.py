"""Reached only by `python -m jaxil.launch` beside a checkout that is not installed."""

raise SystemExit(
    "jaxil is not installed in this Python, which found the folder launch/ of a "
    "checkout instead: go into the checkout, or install it with `pip install CHECKOUT`."
)
