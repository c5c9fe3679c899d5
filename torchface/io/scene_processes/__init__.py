"""Scenes that another process reads: how it is run, and what it hands over."""
