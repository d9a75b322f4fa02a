"""The Fetch suite: a robot arm, a block and a target marker, shown as numbers or as a camera's pictures."""
