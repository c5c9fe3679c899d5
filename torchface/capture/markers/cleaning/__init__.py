"""Marker takes cleaned: outliers, exchanged labels, gaps."""
