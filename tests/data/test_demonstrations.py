import collections
import contextlib
import dataclasses
import itertools
import logging
import re
from pathlib import Path
from typing import Any

import gymnasium
import minari
import numpy as np
import pytest
import torch
from helpers import same_demonstrations
from numpy.typing import NDArray

from clbench.base.cache import CacheError
from clbench.base.entry_points import resolve
from clbench.base.errors import InputError, WrongTypeError
from clbench.data.demonstrations import (
    Demonstration,
    Demonstrations,
    collect,
    dataset_folder,
    dataset_id,
    demonstrate,
    has_dataset,
    read_dataset,
)
from clbench.spec.budget import Budget
from clbench.spec.language import encode
from clbench.spec.registry import load_scenario
from clbench.testing import ToyWorld

State = NDArray[np.float32]
TOY = load_scenario("clbench.testing:clbench/Toy-v0")
TASK = TOY.task("left")
BUDGET = dataclasses.replace(TOY.budget, demonstrations=5)


def test_demonstrations_are_made_once_and_come_back_as_they_were(empty_caches: Path) -> None:
    folder = dataset_folder(TASK, BUDGET)
    assert folder == empty_caches / "minari" / dataset_id(TASK, BUDGET)
    written = (folder / "data" / "main_data.hdf5").stat().st_mtime_ns
    assert dataset_folder(TASK, BUDGET) == folder
    assert (folder / "data" / "main_data.hdf5").stat().st_mtime_ns == written
    assert same_demonstrations(read_dataset(folder), collect(TASK, BUDGET))


def test_others_read_them_with_minari(empty_caches: Path) -> None:
    dataset_folder(TASK, BUDGET)
    name = dataset_id(TASK, BUDGET)
    assert re.fullmatch(r"clbench/toy/[0-9a-f]{16}/left-v0", name)
    assert list(minari.list_local_datasets()) == [name]
    dataset = minari.load_dataset(name)
    assert dataset.total_episodes == 5
    episode = dataset[0]
    assert episode.observations.shape[0] == len(episode.actions) + 1 == len(episode.infos["expert_action"])
    assert episode.terminations[-1]


def test_a_dataset_recovers_the_environment_that_made_it(empty_caches: Path) -> None:
    dataset_folder(TASK, BUDGET)
    dataset = minari.load_dataset(dataset_id(TASK, BUDGET))
    with contextlib.closing(dataset.recover_environment()) as env:
        _, info = env.reset(seed=0)
        assert info["task"] == TASK.name
        expert, ended = resolve(TASK.expert)(TASK.name), False
        state, _ = env.reset(seed=1)
        while not ended:
            state, _, success, truncated, _ = env.step(expert(state))
            ended = success or truncated
        assert success
        env.reset(seed=0)
        steps = 0
        while not truncated:
            *_, truncated, _ = env.step(np.zeros(2, np.float32))
            steps += 1
        assert steps == TASK.horizon
        assert env.reset(options={"task": "up"})[1]["task"] == "up"


def test_the_seed_of_an_episode_leads_to_its_first_state(empty_caches: Path) -> None:
    dataset_folder(TASK, BUDGET)
    dataset = minari.load_dataset(dataset_id(TASK, BUDGET))
    seeds = [facts["seed"] for facts in dataset.storage.get_episode_metadata(range(5))]
    assert len({*seeds}) == 5
    with contextlib.closing(dataset.recover_environment()) as env:
        for seed, episode in zip(seeds, dataset, strict=True):
            state, _ = env.reset(seed=seed)
            assert np.array_equal(state, episode.observations[0])


def test_two_budgets_or_versions_never_share_a_folder(empty_caches: Path) -> None:
    others = (
        (TASK, dataclasses.replace(BUDGET, demonstrations=3)),
        (TASK, dataclasses.replace(BUDGET, noisy_demonstrations=0.9)),
        (dataclasses.replace(TASK, horizon=TASK.horizon - 1), BUDGET),
    )
    first = dataset_folder(TASK, BUDGET)
    written = (first / "data" / "main_data.hdf5").stat().st_mtime_ns
    assert len({first, *(dataset_folder(task, budget) for task, budget in others)}) == 4
    assert [len(read_dataset(dataset_folder(*one))) for one in ((TASK, BUDGET), *others)] == [5, 3, 5, 5]
    assert (first / "data" / "main_data.hdf5").stat().st_mtime_ns == written
    assert not list((empty_caches / "minari").rglob("*.partial"))


def test_a_torn_dataset_is_named_and_made_again(empty_caches: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = dataset_folder(TASK, BUDGET)
    before = read_dataset(folder)
    data = folder / "data" / "main_data.hdf5"
    data.write_bytes(data.read_bytes()[: data.stat().st_size // 2])
    with caplog.at_level(logging.WARNING):
        assert same_demonstrations(read_dataset(dataset_folder(TASK, BUDGET)), before)
    assert f"{folder} is torn" in caplog.text


@pytest.mark.parametrize("place", ["", "~/data"])
def test_an_empty_place_of_minari_is_no_folder_and_a_tilde_is_the_home(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("MINARI_DATASETS_PATH", place)
    folder = dataset_folder(TASK, BUDGET)
    assert folder == tmp_path / (place[2:] or ".minari/datasets") / dataset_id(TASK, BUDGET)
    assert has_dataset(TASK, BUDGET)


def test_a_place_that_cannot_hold_datasets_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "file"))
    with pytest.raises(CacheError, match="cannot be written: Not a directory"):
        dataset_folder(TASK, TOY.budget)


@pytest.mark.long
def test_every_kept_episode_succeeds_and_about_half_are_noisy() -> None:
    episodes = collect(load_scenario("clbench/Fetch-v1").task("press"), Budget(demonstrations=20))
    assert len(episodes) == 20
    assert all(episode.success for episode in episodes)
    assert 3 <= sum(bool(episode.noisy.any()) for episode in episodes) <= 15


def test_the_recorded_actions_replay_to_the_recorded_states_bit_for_bit() -> None:
    task = load_scenario("clbench/Fetch-v1").task("push_right")
    world = resolve(task.world)()
    episode = demonstrate(world, task, seed=7, noisy=True)
    state, _ = world.reset(seed=7, options={"task": task.name})
    states = [state] + [world.step(action)[0] for action in episode.executed]
    assert np.array_equal(np.array(states), episode.state)


def test_three_to_six_random_actions_in_a_row_replace_the_experts(monkeypatch: pytest.MonkeyPatch) -> None:
    stay = np.zeros(2, np.float32)
    monkeypatch.setattr("clbench.testing.lazy_expert", lambda _: lambda state: stay, raising=False)
    task = dataclasses.replace(TASK, expert="clbench.testing:lazy_expert", horizon=40, action_noise=0.02)
    lengths = []
    for seed in range(200):
        episode = demonstrate(ToyWorld(), task, seed, noisy=True)
        random = (episode.executed != 0).any(axis=1)
        assert np.array_equal(random, episode.noisy[:-1])
        runs = [(is_random, len(list(run))) for is_random, run in itertools.groupby(random)]
        lengths += [length for is_random, length in runs[:-1] if is_random]  # the last may be cut short
    counts = collections.Counter(lengths)
    assert min(counts) == 3
    assert all(counts[length] > 0.1 * len(lengths) for length in (3, 4, 5, 6))
    assert sum(counts[length] for length in counts if length > 6) < 0.1 * len(lengths)  # two in succession


class OneArray(gymnasium.Wrapper[State, State, State, State]):
    """A world that returns the same array in every step."""

    def reset(self, **options: Any) -> tuple[State, dict[str, Any]]:
        self.array, info = self.env.reset(**options)
        return self.array, info

    def step(self, action: State) -> Any:
        self.array[:], *rest = self.env.step(action)
        return self.array, *rest


def test_a_world_may_return_the_same_array_in_every_step() -> None:
    usual, other = (demonstrate(world, TASK, 3, True) for world in (ToyWorld(), OneArray(ToyWorld())))
    assert same_demonstrations([usual], [other])


def one_array_expert(task: str) -> Any:
    """Return the toy's expert, which writes all actions into the same array."""
    act, array = resolve(TASK.expert)(task), np.zeros(2)

    def write(state: State) -> Any:
        array[:] = act(state)
        return array

    return write


def test_an_expert_may_return_the_same_array_in_every_step() -> None:
    one_array = dataclasses.replace(TASK, expert=f"{__name__}:one_array_expert")
    usual, other = (demonstrate(ToyWorld(), task, 3, True) for task in (TASK, one_array))
    assert same_demonstrations([usual], [other])


def test_an_expert_that_mostly_fails_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    lazy = dataclasses.replace(TASK, expert="clbench.testing:lazy_expert")
    monkeypatch.setattr(
        "clbench.testing.lazy_expert", lambda _: lambda state: np.zeros(2, np.float32), raising=False
    )
    with pytest.raises(InputError, match=r"The expert of 'left' succeeded 0 times in 10 attempts"):
        collect(lazy, BUDGET)


def test_an_expert_that_returns_no_action_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    silent = dataclasses.replace(TASK, expert="clbench.testing:silent_expert")
    monkeypatch.setattr("clbench.testing.silent_expert", lambda _: lambda state: None, raising=False)
    with pytest.raises(
        WrongTypeError, match=r"silent_expert of task left must return .* of shape \(2,\), not"
    ):
        collect(silent, BUDGET)


def _episode(noisy: list[bool]) -> Demonstration:
    """Return an episode whose state and expert action at step t are both t."""
    steps = len(noisy)
    counting = np.arange(steps + 1, dtype=np.float32)[:, None]
    return Demonstration(
        counting, counting[:-1] + 100, counting, np.array([*noisy, False]), np.zeros(steps), True
    )


def test_chunks_hold_the_experts_next_actions_up_to_the_end() -> None:
    data = Demonstrations.of_task(TASK, [_episode([False] * 4)], chunk=3)
    assert data.state[:, 0].tolist() == [0, 1, 2, 3]
    assert data.action[:, :, 0].tolist() == [[0, 1, 2], [1, 2, 3], [2, 3, 3], [3, 3, 3]]
    assert data.valid.tolist() == [[1, 1, 1], [1, 1, 1], [1, 1, 0], [1, 0, 0]]


def test_actions_after_action_noise_inside_a_chunk_do_not_count() -> None:
    data = Demonstrations.of_task(TASK, [_episode([False, True, True, False, False])], chunk=3)
    # the first noisy step still shows what the expert would have done there; later steps do not
    assert data.valid.tolist() == [[1, 1, 0], [1, 0, 0], [1, 0, 0], [1, 1, 0], [1, 0, 0]]


def _constant_task(name: str, steps: int) -> Demonstrations:
    words = ("go left", "move to the left") if name == "left" else ("go up",)
    task = dataclasses.replace(TASK, name=name, instructions=words)
    return Demonstrations.of_task(task, [_episode([False] * steps)], chunk=2)


def test_samples_draw_tasks_evenly_with_their_own_words() -> None:
    data = Demonstrations.cat([_constant_task("left", 50), _constant_task("up", 5)])
    batch = data.sample(2000, torch.Generator().manual_seed(0))
    up = (batch.words == encode(["go up"])).all(dim=1)
    assert 900 < int(up.sum()) < 1100
    assert float(batch.state[up].max()) == 4
    wordings = {tuple(row) for row in batch.words[~up].tolist()}
    assert wordings == {tuple(row) for row in encode(["go left", "move to the left"]).tolist()}


def test_the_same_generator_draws_the_same_sample() -> None:
    data = _constant_task("left", 50)
    first, second = (data.sample(8, torch.Generator().manual_seed(3)) for _ in range(2))
    assert all(a.equal(b) for a, b in zip(vars(first).values(), vars(second).values(), strict=True))


def test_the_executed_actions_lie_in_the_action_space(monkeypatch: pytest.MonkeyPatch) -> None:
    wild = dataclasses.replace(TASK, expert="clbench.testing:wild_expert")
    monkeypatch.setattr(
        "clbench.testing.wild_expert", lambda _: lambda state: np.full(2, -5.0, np.float32), raising=False
    )
    episode = demonstrate(resolve(wild.world)(), wild, seed=0, noisy=False)
    assert np.abs(episode.executed).max() == 1.0
    assert np.array_equal(episode.executed, episode.expert[:-1])
