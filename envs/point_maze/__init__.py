"""The PointMaze suite: a ball and three mazes of nine rooms."""
