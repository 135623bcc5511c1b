"""Whether a model holds together: what joins neighbours, and views from far apart in time."""
