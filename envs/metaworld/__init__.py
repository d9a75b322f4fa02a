"""The Meta-World suite: a robot arm with drawers, windows, faucets, buttons and blocks."""
