"""MediaPipe's Face Landmarker: its bundle of three networks, read and run in this process."""
