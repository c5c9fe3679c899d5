"""A head model fitted to photographs: pose, identity, expression, texture."""
