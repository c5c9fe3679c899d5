"""What files of scenes share: pieces of a rig put together, and weights as keys of its animation."""
