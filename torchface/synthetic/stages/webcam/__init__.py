"""Videos of synthetic people who sit before a webcam, with the truth about every frame."""
