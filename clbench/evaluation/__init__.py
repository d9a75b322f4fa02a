"""Evaluation: rollouts of a policy, episodes of any agent, answers, probes, and the definition of a scenario."""
