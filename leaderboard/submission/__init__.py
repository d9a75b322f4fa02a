"""Submission and verification of records."""
