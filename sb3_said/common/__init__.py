"""Building blocks shared by the algorithms: replay, windows, extractors, saving."""
