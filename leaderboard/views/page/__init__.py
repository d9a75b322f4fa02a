"""The HTML page: the whole leaderboard in one file that needs no network, and the pictures of the README."""

from .html import page, pictures

__all__ = ["page", "pictures"]
