"""Demonstrations in and out: LeRobot and HDF5 files of others, and tasks that learn from such a file."""
