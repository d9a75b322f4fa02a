"""The forms of the leaderboard: terminal, Markdown, CSV and, in `page`, HTML."""
