"""Parts of all scene files: pieces of a rig put together, and weights as keys of its animation."""
