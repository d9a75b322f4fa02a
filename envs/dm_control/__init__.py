"""The dm_control suite: a point mass, a cart with a pole, and a ball on a string with a cup."""
