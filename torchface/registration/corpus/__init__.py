"""Many scans registered to one template, in processes or on a cluster, with a record of each."""
