"""Regression trees that find landmarks in a face box."""
