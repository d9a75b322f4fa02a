"""Records: the file that each run leaves, and how it is read, written and named."""
