"""Colours of eyes, lashes and other parts of a head that bring none."""
