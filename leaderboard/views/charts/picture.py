"""A chart as a picture, for notebooks and papers."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import vl_convert

from clbench.base.errors import InputError

from .vega import Spec, colour, in_theme

VEGA_LITE = "6.4"
"""Version of Vega-Lite that the charts are written for."""

WRITERS: dict[str, Callable[..., bytes | str]] = {
    ".svg": vl_convert.vegalite_to_svg,
    ".png": lambda spec, **options: vl_convert.vegalite_to_png(spec, scale=2, **options),
    ".pdf": vl_convert.vegalite_to_pdf,
}
"""Functions that draw a chart, by the ending of the file."""


@dataclass(frozen=True)
class Plot:
    """A chart. Notebooks show it, and `save` writes it."""

    spec: Spec
    """The chart in Vega-Lite, which other programs can draw, too."""

    def svg(self) -> str:
        """Return the chart as SVG."""
        return str(vl_convert.vegalite_to_svg(self.spec, vl_version=VEGA_LITE))

    _repr_svg_ = svg
    """What notebooks show."""

    def __repr__(self) -> str:
        return "<Plot: a notebook shows it, save('chart.svg') writes it>"

    def save(self, path: Path | str) -> None:
        """Write the chart to a file that ends with .svg, .png or .pdf.

        Raises:
            InputError: The file has another ending.
        """
        path = Path(path)
        write = WRITERS.get(path.suffix.lower())
        if write is None:
            raise InputError(f"{path} must end with one of {', '.join(WRITERS)}.")
        made = write(self.spec, vl_version=VEGA_LITE)
        path.write_bytes(made.encode() if isinstance(made, str) else made)


def on_paper(spec: Spec) -> Plot:
    """Return a chart with a background, whose colours are still the names of `PALETTE`."""
    return Plot({**spec, "config": {**spec["config"], "background": colour("paper")}})


def themed(spec: Spec, dark: bool) -> Plot:
    """Return a chart with a background, in the colours of a theme."""
    return Plot(json.loads(in_theme(json.dumps(on_paper(spec).spec), dark)))


def in_both_themes(stem: str, spec: Spec) -> dict[str, str]:
    """Return a chart as SVG, for a light and a dark page, by the names of its files."""
    svg = on_paper(spec).svg() + "\n"
    return {f"{stem}.svg": in_theme(svg, dark=False), f"{stem}-dark.svg": in_theme(svg, dark=True)}
