"""Reading of one face in a camera's pictures, frame after frame, by tensor operations alone: it goes into graphs."""
