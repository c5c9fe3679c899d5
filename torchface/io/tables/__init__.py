"""Tables of numbers along frames as text: CSV, frame rates, timecodes."""
