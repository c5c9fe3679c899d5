"""Results compared with the truth."""
