"""Rigs as files: glTF, folders of OBJ files, ICT-FaceKit."""
