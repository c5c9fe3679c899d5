"""glTF 2.0 with morph targets, read from whoever wrote it and written for whoever reads it."""
