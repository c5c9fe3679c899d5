"""Images and curves: faces with errors as heat maps, markers, models, motion."""
