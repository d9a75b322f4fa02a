"""Views of the board: the terminal, Markdown, CSV and the page for a browser."""
