"""Worlds: simulated episodes side by side, what a policy observes of them, and the Gymnasium environments."""
