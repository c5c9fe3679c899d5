"""Recipes: one file each, listed by `torchface train`; in the wheel as ``torchface._train``."""
