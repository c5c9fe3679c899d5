"""People as cameras see them, which networks and trees of faces learn from: heads, looks, expressions, scenes."""
