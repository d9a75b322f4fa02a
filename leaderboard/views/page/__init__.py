"""The HTML page: the whole leaderboard in one file that needs no network, and its charts as pictures."""

from .html import page, pictures

__all__ = ["page", "pictures"]
