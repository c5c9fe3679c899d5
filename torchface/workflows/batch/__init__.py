"""Many scans, takes or videos by one command: here, in processes, or on a cluster; a record of each, one table."""
