"""Figures, reports that open from disk, pages in a browser."""
