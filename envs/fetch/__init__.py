"""The Fetch robot, a block and a target marker, shown to a policy as numbers."""
