"""Landmarks of faces in images and videos: face boxes, networks, regression trees, appearance model, tracking."""
