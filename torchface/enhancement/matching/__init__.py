"""The database's frames that look like an input, region by region."""
