"""The browser app; a package, so that its fixtures, a film that plays in Chromium, end with its last test."""
