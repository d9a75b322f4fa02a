"""The charts as specifications of Vega-Lite, for the page and for pictures."""
