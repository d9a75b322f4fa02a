"""docs/reference/performance.md and its picture, from benchmarks/results/: `python benchmarks/report.py`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import vl_convert
from result_files import read_results

from clbench.base.entry_points import resolve

DOCS = Path(__file__).parents[1] / "docs" / "reference"
VEGA_LITE = resolve("clbench.leaderboard.views.charts.picture:VEGA_LITE")

INTRODUCTION = """\
# Performance

`python benchmarks/report.py` makes this page from `benchmarks/results/`; `make benchmark` measures these.
Ratios compare blocks that take turns on one machine: the median over rounds, with a 95 % bootstrap interval,
or with the lowest and the highest value where there are fewer than six rounds. Seconds depend on that machine
and cannot be compared with another machine's. The machine was otherwise idle, except during LIBERO's steps
and some whole runs, when other programs used part of it.
"""
TRIED = """\
## What was tried

Each change was measured once, alternating with the present code, on two cores of an AMD EPYC, in most cases
without AVX-512.

| change | result | kept |
| --- | --- | --- |
| fused AdamW | a step takes 0.92 of the time | yes |
| bfloat16, by autocast | a step takes 8.9 times as long, 2.1 times with AVX512-BF16 | no |
| `torch.compile` | a step takes 1.2 times as long, the first one two minutes | no |
| no padding words in a batch | no gain beyond noise, the same bits | no |
| no collisions between robot parts that never touched on Fetch | 6 % of the physics; not provably safe | no |
| vector worlds, for a whole run on one core | no gain: the physics was at the limit before | for threads |
| `mujoco.rollout` | other bits, because it drops the solver's warm start | no |
| observing Fetch's lanes while others still move | at most 5 %, because observing takes no more | no |
| half steps of Fetch as work items for threads; fixed shares of lanes | 1 % faster; 7 % slower | no |
| no geoms in LIBERO's physics that are only seen | 15 to 30 % faster, 0.9 of 2.3 GB, the same bits | yes |
| Meta-World's rewards and observations in batches | 2 to 3.5 times the speed, the same bits | yes |
| queues in C instead of an executor between threads | 2 to 4 % faster on Meta-World, no gain on Fetch | yes |
| dm_control's rewards in batches, for the body where the bits agree | 1.4 times the speed | yes |
| one Ray process per job | 5 s per job to import everything | no |
| Ray's workers at Ray's own niceness, 15 | 25 times as slow next to other work | no |
| reading all lanes at once, or each where it was advanced | a third less time outside the physics | yes |
| importing PyTorch's compiler before jobs are forked | saves a second per job | yes |
| an idle second core also steps a run's worlds | `sft` on Fetch-v1 takes 0.84 of the time | yes |
| lanes with many contacts first | no gain: contacts predict the time of a step poorly | no |
"""
UNITS = {
    "tasks": "tasks of Meta-World, 4 episodes of 50 steps each",
    "episodes": "episodes of Fetch",
    "environments": "Fetch environments, 20 steps each",
    "demonstrations": "demonstrations, 10 optimiser steps",
}


def _read(name: str) -> Any:
    found = read_results(name)
    if found is None:
        raise SystemExit(f"There is no results/{name}.json: python benchmarks/{name}.py makes it.")
    return found


def _measured(found: dict[str, Any]) -> str:
    """Return when and on which processor results were measured; old results do not say when."""
    hardware = found["hardware"]
    date = [found["date"]] if "date" in found else []
    return ", ".join([*date, f"{hardware['processor']} with {hardware['instructions']}"])


def _ratio(ratio: dict[str, float] | None) -> str:
    if ratio is None:  # not compared
        return "-"
    if ratio["low"] == ratio["high"]:  # one round only, or a ratio to itself
        return f"{ratio['median_ratio']:.2f}"
    return f"{ratio['median_ratio']:.2f} [{ratio['low']:.2f}, {ratio['high']:.2f}]"


def _table(head: list[str], rows: list[list[str]]) -> Iterator[str]:
    """Yield a table of Markdown; all columns but the first are numbers."""
    under = ["---", *["--:"] * (len(head) - 1)]
    yield from (f"| {' | '.join(cells)} |" for cells in (head, under, *rows))
    yield ""


def _rollouts() -> Iterator[str]:
    suites = _read("rollouts")["suites"]
    sizes = {(suite["num_envs"], suite["threads"]) for suite in suites.values()}
    if len(sizes) > 1:
        raise SystemExit("The suites were measured with different numbers of environments or threads.")
    ((num_envs, threads),) = sizes
    yield "## Environment steps"
    yield ""
    yield (
        f"Speed of `gym.make_vec(id, num_envs={num_envs})` with {threads} threads, as a multiple of common "
        "vector environments on the suite's own environment, and of `mj_step` alone on as many threads, "
        "which is the upper limit. On LIBERO it is not: there, `mj_step` steps LIBERO's whole model, "
        "including the visual geoms, with the arm at rest. Of dm_control's three bodies, the row measures "
        "the ball in a cup, whose rewards are computed together; in our task, the cup is held to the right. "
        "Steps per second are the steps of all environments together. Where rows come from different "
        "machines, compare ratios, not steps."
    )
    yield ""
    one_thread = "clbench, one thread"
    others = ["AsyncVectorEnv", "SubprocVecEnv", "SyncVectorEnv of ours", one_thread, "mj_step"]
    yield from _table(
        ["suite (peer)", "steps / s", "with one thread", *others, "measured"],
        [
            [
                f"{name} ({suite['peer']})",
                str(suite["steps_per_second"]["clbench"]),
                str(suite["steps_per_second"][one_thread]),
                *(_ratio(suite["ratios_of_clbench_to"].get(other)) for other in others),
                _measured(suite),
            ]
            for name, suite in suites.items()
        ],
    )


def _whole_run() -> Iterator[str]:
    runs = _read("whole_run")["runs"]
    yield "## A whole run"
    yield ""
    yield (
        "One thread. Data and pretrained policy are in the cache; the first evaluation, which the runs of a "
        "seed share, is not. Where rows come from different machines, compare shares, not seconds."
    )
    yield ""
    parts = list(next(iter(runs.values()))["parts"])
    yield from _table(
        ["run", "seconds", *parts, "environment steps", "peak memory", "measured"],
        [
            [
                f"{name}, {run['method']}",
                f"{run['seconds']:.0f}",
                *(f"{run['parts'][part] / run['seconds']:.0%}" for part in parts),
                f"{run['environment_steps']:,}",
                f"{run['peak_memory_gb']:.2f} GB",
                _measured(run),
            ]
            for name, run in runs.items()
        ],
    )


def _steps() -> Iterator[str]:
    steps = _read("step_time")
    yield "## A step of adaptation"
    yield ""
    yield (
        f"Plain fine-tuning takes {1000 * steps['baseline_seconds_per_step']:.0f} ms per step. A bare "
        f"PyTorch loop on the same model and batches takes {_ratio(steps['bare_loop'])} of that time. Other "
        f"methods, as ratios ({_measured(steps)}):"
    )
    yield ""
    ratios = sorted(steps["ratios"].items(), key=lambda item: item[1]["median_ratio"])
    yield from _table(["method", "step time"], [[name, _ratio(ratio)] for name, ratio in ratios])


def _workers() -> Iterator[str]:
    found = _read("workers")
    count = found["workers"]
    seconds = ", ".join(f"{way} {taken:.0f} s" for way, taken in found["seconds"].items())
    *_, ray = found["seconds"]
    yield "## Workers"
    yield ""
    yield (
        f"In {found['rounds']} rounds, one worker takes {_ratio(found['one_worker_to_many'])} times "
        f"as long for {found['runs']} runs as {count} workers do. A Ray cluster of {count} workers takes "
        f"{_ratio(found['ray_to_many'])} times as long as {count} local workers ({seconds}). The "
        "records are the same. Each Ray worker keeps a process that has imported everything, and forks each "
        f"job from it. A cluster with these processes starts in {found['seconds_to_start'][ray]:.0f} s; the "
        f"times do not include that. Measured: {_measured(found)}."
    )
    yield ""


def _served_policy() -> Iterator[str]:
    found = _read("served_policy")
    yield "## A served policy"
    yield ""
    yield (
        "Behind a server on the same machine, the policy plays "
        f"{_ratio(found['served_to_in_process'])} times as many episodes per second as in the process that "
        f"scores it, 40 in parallel. All {found['episodes']} outcomes are equal. "
        f"Measured: {_measured(found)}."
    )
    yield ""


def _page() -> Iterator[str]:
    found = _read("page")
    board, page = found["seconds"].values()
    yield "## The page of the board"
    yield ""
    yield (
        f"A page of {found['rows']} rows with {found['seeds']} seeds each has {found['megabytes']:.2f} MB. "
        f"The board takes {board:.0f} s, and the page with its pictures {page:.0f} s; the goal is 20 s "
        f"together. Measured: {_measured(found)}."
    )
    if "first_text_ms" in found:
        published, empty = found["first_text_ms"].values()
        yield (
            f"Chromium shows the first text of the published page after {published:.0f} ms; an empty "
            f"page takes {empty:.0f} ms."
        )
    yield ""


def _scaling() -> Iterator[str]:
    found = _read("scaling")
    yield "## How cost grows"
    yield ""
    yield "![Seconds over size, with the straight line through the points](performance.svg)"
    yield ""
    yield from _table(
        ["quantity", "sizes", "seconds", "per additional one", "largest deviation from the line"],
        [
            [
                UNITS[name],
                ", ".join(map(str, one["sizes"])),
                ", ".join(f"{seconds:.2f}" for seconds in one["seconds"]),
                _milliseconds(one["seconds_each"]),
                f"{one['farthest_off']:.0%}",
            ]
            for name, one in found["measures"].items()
        ],
    )
    yield (
        f"Peak memory of all measurements together: {found['peak_memory_gb']:.2f} GB. "
        f"Measured: {_measured(found)}."
    )


def _milliseconds(seconds: float) -> str:
    """Return a duration with two digits; a slope of pure noise is shown as 0."""
    milliseconds = round(1000 * seconds, 2)
    return f"{float(f'{milliseconds:.2g}') + 0.0:g} ms"


def _picture() -> str:
    panels = []
    for name, one in _read("scaling")["measures"].items():
        points = [
            {"size": size, "seconds": seconds, "line": one["seconds_each"] * size + one["seconds_at_none"]}
            for size, seconds in zip(one["sizes"], one["seconds"], strict=True)
        ]
        x = {"field": "size", "type": "quantitative", "title": name, "axis": {"tickCount": 5, "grid": False}}
        axis = {"tickCount": 4}
        panels.append(
            {
                "width": 170,
                "height": 130,
                "data": {"values": points},
                "layer": [
                    {
                        "mark": {"type": "line", "color": "#9aa4b2"},
                        "encoding": {"x": x, "y": {"field": "line", "type": "quantitative"}},
                    },
                    {
                        "mark": {"type": "point", "filled": True, "size": 45, "color": "#1f6feb"},
                        "encoding": {
                            "x": x,
                            "y": {
                                "field": "seconds",
                                "type": "quantitative",
                                "title": "seconds",
                                "axis": axis,
                                "scale": {"domainMin": 0},
                            },
                        },
                    },
                ],
            }
        )
    spec = {"hconcat": panels, "config": {"background": "white", "view": {"stroke": None}}}
    return str(vl_convert.vegalite_to_svg(spec, vl_version=VEGA_LITE)) + "\n"


def main() -> None:
    """Write the page and the picture."""
    sections = (_rollouts, _whole_run, _steps, _workers, _served_policy, _page, _scaling)
    measured = (line for section in sections for line in section())
    text = "\n".join([INTRODUCTION, *measured, "", TRIED])
    (DOCS / "performance.md").write_text(text.rstrip("\n") + "\n", encoding="utf-8")
    (DOCS / "performance.svg").write_text(_picture(), encoding="utf-8")
    print(f"{DOCS / 'performance.md'} and performance.svg are written.")


if __name__ == "__main__":
    main()
