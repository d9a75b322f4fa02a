"""Specifications as data: tasks, scenarios, budgets and the evaluation protocol."""
