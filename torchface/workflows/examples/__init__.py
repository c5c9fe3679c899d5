"""Examples of a person's expressions, from pictures or before a webcam."""
