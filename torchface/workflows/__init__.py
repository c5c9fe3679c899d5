"""Whole jobs from files to files, one folder or file a job."""
