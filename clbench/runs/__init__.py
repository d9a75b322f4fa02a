"""Runs: one scenario, one method and one seed, from the pretrained policy to a record."""
