"""A face before a camera, solved and sent on as it moves."""
