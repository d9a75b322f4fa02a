"""`python -m clbench.pretrained ID`: pretrain a policy, and let it ship."""

from __future__ import annotations

import argparse
import shutil

from clbench.jobs.bars import Bars
from clbench.learning.pretraining import pretrained_policy, shipped_folder, vision_steps
from clbench.spec.registry import load_scenario


def main() -> None:
    """Read the command line and do what it says."""
    parser = argparse.ArgumentParser(prog="python -m clbench.pretrained", description=__doc__)
    parser.add_argument("scenario", help='as "clbench/Fetch-v0"')
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    scenario = load_scenario(arguments.scenario)
    length = scenario.budget.pretraining_steps + vision_steps(scenario)
    with Bars(length) as bars:
        name = f"{scenario.id} pretraining seed {arguments.seed}"
        bars.start(name, length)
        _, folder = pretrained_policy(scenario, arguments.seed, lambda steps: bars.advance(name, steps))
        shipped = shipped_folder(scenario, arguments.seed)
        if folder != shipped:
            shutil.rmtree(shipped, ignore_errors=True)
            shutil.copytree(folder, shipped)
        bars.finish(name, f"in {shipped}")


if __name__ == "__main__":
    main()
