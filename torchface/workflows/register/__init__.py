"""Many scans registered to one template."""
