"""Evaluation: rollouts of a policy, its answers to questions, and probes of its weights and activations."""
