"""A character driven by whoever sits before a webcam."""
