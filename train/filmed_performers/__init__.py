"""Performers with painted patterns and markers, filmed by a camera on a helmet: a head-camera session made by code."""
