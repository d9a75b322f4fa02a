"""The board: which records may be compared, and the rows that they make."""
