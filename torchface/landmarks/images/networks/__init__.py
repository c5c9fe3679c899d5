"""Networks that read landmarks and eyes from crops of faces, and the finders that run them."""
