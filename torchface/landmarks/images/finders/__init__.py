"""Who finds landmarks in a box: regression trees, networks, other packages."""
