"""The LIBERO suites: a Panda arm that moves bowls, boxes and bottles, and uses a cabinet and a stove."""
