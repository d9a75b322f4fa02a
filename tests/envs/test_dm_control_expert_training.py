"""The training of experts of the dm_control world."""

import importlib
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clbench.base.seeding import seeded

pytest.importorskip("dm_control", reason="dm-control is not for this version of Python")
SAC = pytest.importorskip("stable_baselines3", reason="the extra online is not installed").SAC
expert, sac, training = (
    importlib.import_module(f"clbench.envs.dm_control.{name}")
    for name in ("experts", "expert_training.sac", "expert_training.train")
)


def tiny(task: str = "point_mass_easy", steps: int = 600) -> Any:
    """Return a training too short to learn: 200 random decisions, then 100 gradient steps per 200."""
    return training.Settings(task, steps=steps, width=8, batch_size=16, segment=200)


class KilledError(Exception):
    """Raised in place of a kill."""


def killed_after(steps: int) -> Callable[[float, str], None]:
    done = 0.0

    def progress(amount: float, _: str) -> None:
        nonlocal done
        done += amount
        if done >= steps:
            raise KilledError

    return progress


@pytest.mark.slow
def test_a_training_that_was_killed_ends_in_the_same_bytes(empty_caches: Path) -> None:
    whole, killed = empty_caches / "whole", empty_caches / "killed"
    training.train(tiny(), whole)
    path = training.checkpoint_path(tiny())
    path.unlink()
    for steps in (200, 400):
        with pytest.raises(KilledError):
            training.train(tiny(), killed, killed_after(steps))
        assert not list(killed.glob("*"))
    lines: list[str] = []
    training.train(tiny(), killed, lambda _, line: lines.append(line))
    assert lines[0] == f"continues after 400 steps, from {path}"
    assert len(lines) == 2
    for name in ("point_mass_easy.safetensors", "point_mass_easy.json"):
        assert (killed / name).read_bytes() == (whole / name).read_bytes()


@pytest.mark.slow
def test_a_longer_training_continues_a_shorter_one_and_not_the_other_way_round(empty_caches: Path) -> None:
    training.train(tiny(steps=400), empty_caches)
    card = training.train(tiny(steps=600), empty_caches)
    assert [steps for steps, _ in card["curve"]] == [200, 400, 600]
    with pytest.raises(expert.ExpertError, match="has 600 steps, more than 400"):
        training.train(tiny(steps=400), empty_caches)


@pytest.mark.long
def test_the_json_records_the_command_and_the_results_of_the_weights(empty_caches: Path) -> None:
    said = training.train(tiny(steps=200), empty_caches)
    assert said == json.loads((empty_caches / "point_mass_easy.json").read_text(encoding="utf-8"))
    assert said["command"] == "clbench experts train point_mass_easy --seed 0 --steps 200"
    assert said["episodes"] == 100
    assert said["lowest_return"] <= said["return"]
    trained, mean = expert.read_expert(empty_caches, "point_mass_easy")
    assert mean == said["return"]
    again = training.returns(trained, "point_mass_easy", "test", said["episodes"])
    assert round(float(again.mean()), 3) == mean


@pytest.mark.slow
def test_a_symmetric_task_is_trained_as_the_one_that_it_mirrors(empty_caches: Path) -> None:
    said = training.train(tiny("point_mass_left", steps=200), empty_caches)
    assert said["symmetric_to"] == "point_mass_right"
    assert training.checkpoint_path(tiny("point_mass_right")).exists()
    training.train(tiny("point_mass_right", steps=200), empty_caches)
    mirrored, _ = expert.read_expert(empty_caches, "point_mass_left")
    original, _ = expert.read_expert(empty_caches, "point_mass_right")
    observation, mirror = np.array([0.25, 0.1, 0.02, -0.03]), np.array([-1, 1, -1, 1])
    assert mirrored.act(observation) == pytest.approx(
        original.act(mirror * observation) * mirror[:2], abs=1e-6
    )


@pytest.mark.long
def test_a_torn_checkpoint_is_refused_by_name_with_the_way_out(empty_caches: Path) -> None:
    training.train(tiny(steps=200), empty_caches)
    path = training.checkpoint_path(tiny())
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    with pytest.raises(expert.ExpertError, match=r"is not a checkpoint of this training .* Delete it"):
        training.train(tiny(), empty_caches)
    path.write_bytes(b"")
    with pytest.raises(expert.ExpertError, match="Delete it"):
        training.train(tiny(), empty_caches)


@pytest.mark.parametrize("steps", [0, 300, 200_000])
def test_steps_that_are_not_whole_segments_are_refused(steps: int) -> None:
    with pytest.raises(ValueError, match="for a multiple of 200 steps, at most 100,000"):
        tiny(steps=steps)


@pytest.mark.long
def test_training_without_the_extra_names_the_extra_to_install(tmp_path: Path) -> None:
    hide = "import sys; sys.modules['stable_baselines3'] = None; from importlib.util import find_spec"
    program = (
        f"{hide}; import clbench.base.dependencies as extras; extras.find_spec = lambda name: None; "
        "sys.argv = ['clbench', 'experts', 'train', 'cartpole_left']; "
        "from clbench.cli.main import main; main()"
    )
    command = [sys.executable, "-c", program]
    result = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False, cwd=tmp_path)
    assert result.returncode == 2
    assert (
        "Training an expert needs the package stable_baselines3: pip install 'clbench[online]'"
        in result.stderr
    )


@pytest.mark.long
def test_the_written_out_gradient_step_equals_stable_baselines3() -> None:
    trainers = []
    for kind in (SAC, sac.WrittenOutSAC):
        world = training.TrainingWorld("cartpole_left", lambda number: number)
        with seeded("trainer"):
            trainer = kind(
                "MlpPolicy",
                world,
                learning_rate=1e-3,
                buffer_size=400,
                learning_starts=10_000,
                ent_coef="auto_0.1",
                policy_kwargs={"net_arch": [16, 16]},
                device="cpu",
                seed=0,
            )
            trainer.learn(300)
        with seeded("gradients"):
            trainer.train(10, batch_size=32)
        trainers.append(trainer)
    theirs, ours = trainers
    for (name, expected), (again, found) in zip(
        theirs.policy.state_dict().items(), ours.policy.state_dict().items(), strict=True
    ):
        assert name == again
        np.testing.assert_allclose(found, expected, atol=1e-5, err_msg=name)
    assert theirs.log_ent_coef is not None
    assert ours.log_ent_coef is not None
    assert ours.log_ent_coef.item() == pytest.approx(theirs.log_ent_coef.item(), abs=1e-6)
    assert ours.log_ent_coef.item() != pytest.approx(np.log(0.1), abs=1e-3)
