"""VRM avatars: what their extensions of glTF say of expressions."""
