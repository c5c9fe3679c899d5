"""One face followed through a video."""
