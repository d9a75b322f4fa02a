"""Evaluation: rollouts, episodes of any agent, answers, probes of a policy, and the definition of a scenario."""
