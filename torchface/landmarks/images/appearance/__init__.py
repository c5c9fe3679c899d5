"""An appearance model of one person, and the annotated frames that it is learned from."""
