"""From folders of runs to one page: what `python -m jaxil.report` is made of."""
