"""Scenes with the truth beside them, which only tests record: cameras, lights, webcams, painted faces."""
