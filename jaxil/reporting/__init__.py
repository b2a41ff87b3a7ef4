"""From folders of runs to one page: what `jaxil report` is made of."""
