"""Reports as HTML pages with a player of the performance."""
