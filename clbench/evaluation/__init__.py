"""Evaluation: rollouts, episodes of any agent, answers and probes of a policy, a scenario's definition."""
