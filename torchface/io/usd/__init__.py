"""USD with UsdSkel's blend shapes, read from whoever wrote it and written for whoever reads it."""
