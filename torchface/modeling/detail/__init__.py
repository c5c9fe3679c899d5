"""Fine detail of high-resolution scans as normal maps."""
