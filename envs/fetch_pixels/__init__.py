"""The Fetch robot and a block, seen by a camera."""
