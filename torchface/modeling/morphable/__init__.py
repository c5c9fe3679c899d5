"""Morphable models: principal components of shapes and colours, their training and quality."""
