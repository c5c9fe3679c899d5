"""A personal rig: deformation transfer, examples, the regression from neutral to expressions, parts behind the skin."""
