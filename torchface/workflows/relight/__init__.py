"""A filmed face under another light, with another skin or another head."""
