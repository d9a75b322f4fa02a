"""The leaderboard: tables and pages from records, without a network."""

from . import plot

__all__ = ["plot"]
