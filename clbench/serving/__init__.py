"""Policies that another program serves: the server, as one file to copy, its client, and their scores."""
