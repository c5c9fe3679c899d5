"""What people look at: figures, reports that open from disk, pages in a browser."""
