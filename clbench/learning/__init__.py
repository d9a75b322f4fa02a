"""Learning: the method hooks, the optimiser loop, and pretraining."""
