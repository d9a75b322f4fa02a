"""Decoders of a discrete-diffusion policy, as `benchmarks/decoding.py` measured them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clbench.base.strict_json import read_json
from clbench.records.paths import table_name
from clbench.scoring.intervals import Estimate

RESULTS = Path(__file__).parents[1] / "decoding.json"
"""File of the results."""


@dataclass(frozen=True)
class Decoder:
    """One decoder, compared with easy-first decoding in the same rounds and episodes."""

    name: str
    is_pipeline: bool
    """Whether it is the pipeline of a distilled student with kept keys: what Fast-dVLA proposes."""
    success: float
    """Share of the skills' validation episodes that succeed."""
    difference: Estimate
    """Difference in success from easy-first decoding, in paired episodes."""
    forwards: float
    """Mean forwards of the head per chunk."""
    tokens: float
    """Mean tokens in all forwards of a chunk."""
    milliseconds: float
    """Median time of a chunk, with the observation read."""
    speed_up: Estimate
    """Time of easy-first decoding divided by this one's, median of the rounds."""


@dataclass(frozen=True)
class Decoding:
    """The results of the benchmark."""

    scenario: str
    seeds: int
    episodes: int
    """Episodes of each decoder, over all seeds."""
    hardware: str
    decoders: tuple[Decoder, ...]
    """Easy-first decoding comes first."""
    widths: Mapping[int, Mapping[str, Estimate]]
    """Ratios of time by width of the policy: easy-first decoding of a chunk to the pipeline's forwards
    (`chunk`), and one forward of all tokens to one forward of a block (`forward`)."""

    @property
    def table(self) -> str:
        """Name of the table of the policy that was decoded."""
        return table_name(self.scenario, "discrete_diffusion")

    @property
    def best_pipeline(self) -> Decoder:
        """The fastest pipeline."""
        return max((one for one in self.decoders if one.is_pipeline), key=lambda one: one.speed_up.value or 0)


def read_decoding(path: Path = RESULTS) -> Decoding | None:
    """Return the results, None if the benchmark has not written any."""
    if not path.is_file():
        return None
    values: Mapping[str, Any] = read_json(path)
    return Decoding(
        values["scenario"],
        values["seeds"],
        values["episodes"],
        values["hardware"]["processor"],
        tuple(
            Decoder(
                name,
                one["is_pipeline"],
                one["success"],
                Estimate(*one["success_difference"]),
                one["forwards"],
                one["tokens"],
                one["milliseconds"],
                _ratio(one["speed_up"]),
            )
            for name, one in values["decoders"].items()
        ),
        {
            int(width): {name: _ratio(one) for name, one in ratios.items()}
            for width, ratios in values["by_width"].items()
        },
    )


def _ratio(values: Mapping[str, float]) -> Estimate:
    return Estimate(values["median_ratio"], values["low"], values["high"])
