"""Files of Autodesk Maya."""
