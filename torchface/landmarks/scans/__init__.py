"""Landmarks and contours of raw scans, found in an image unwrapped onto a cylinder."""
