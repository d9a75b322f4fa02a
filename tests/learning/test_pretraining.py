import dataclasses
import json
import logging
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from clbench import load_scenario
from clbench.base.cache import MANIFEST, cache_folder, hash_of
from clbench.base.entry_points import resolve
from clbench.base.seeding import derive_seed, torch_generator
from clbench.data.demonstrations import Demonstrations, load_demonstrations
from clbench.data.questions import load_questions
from clbench.learning.pretraining import (
    SHIPPED,
    is_pretrained,
    policy_config,
    pretrain,
    pretrained_folder,
    pretrained_policy,
    pretraining_inputs,
    shipped_folder,
)
from clbench.policy.kinds import new_policy
from clbench.policy.policy import Policy, PolicyConfig
from clbench.policy.transformer import TransformerPolicy

FETCH = load_scenario("clbench/Fetch-v1")
SHIPS = shipped_folder(FETCH, 0)


def _made_from(folder: Path) -> dict[str, object]:
    found = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))["made_from"]
    assert isinstance(found, dict)
    return found


def test_this_source_makes_the_policies_that_ship() -> None:
    shipped = sorted(SHIPPED.glob("*/clbench.json"))
    assert [path.parent for path in shipped] == [SHIPS]
    made_from, present = _made_from(SHIPS), json.loads(json.dumps(pretraining_inputs(FETCH, 0)))
    if made_from["versions"] != present["versions"]:
        pytest.skip(f"it was made with {made_from['versions']}, here are {present['versions']}")
    assert made_from == present, "make it again: clbench pretrain clbench/Fetch-v1 --ship"
    assert pretrained_folder(FETCH, 0) == SHIPS
    assert is_pretrained(FETCH, 0)


def test_the_committed_records_of_a_seed_started_from_the_policy_that_ships() -> None:
    files = json.loads((SHIPS / MANIFEST).read_text(encoding="utf-8"))["files"]
    records = Path(__file__).parents[2] / "leaderboard" / "records" / "Fetch-v1"
    record = json.loads((records / "sft" / "seed-0.json").read_text(encoding="utf-8"))
    assert files["policy.safetensors"].startswith(record["fingerprint"]["pretrained"])


class Weighed(TransformerPolicy):
    """Has pretrained weights of its own, and counts how often they are loaded."""

    pretrained = True
    loaded = 0

    def __init__(self, config: PolicyConfig, seed: int = 0) -> None:
        super().__init__(config, seed)
        type(self).loaded += 1


def test_weights_that_a_policy_brings_are_loaded_once_per_seed_however_many_seeds_and_looks() -> None:
    brief = dataclasses.replace(load_scenario("clbench.testing:clbench/Toy-v0"), policy=f"{__name__}:Weighed")
    before = Weighed.loaded
    first, again = ([pretraining_inputs(brief, seed)["weights"] for seed in range(20)] for _ in range(2))
    assert first == again
    assert Weighed.loaded - before == 20


def test_a_policy_that_learned_other_questions_of_the_same_module_is_another_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    toy = load_scenario("clbench.testing:clbench/Toy-v0")
    monkeypatch.setattr("clbench.testing.OTHER", resolve(toy.questions), raising=False)
    other = dataclasses.replace(toy, questions="clbench.testing:OTHER")
    assert pretrained_folder(other, 0) != pretrained_folder(toy, 0)


class Fixed(TransformerPolicy):
    """Has pretrained weights of its own, the same for all seeds."""

    pretrained = True

    def __init__(self, config: PolicyConfig, seed: int = 0) -> None:
        super().__init__(config, 0)


def test_seeds_of_the_same_weights_share_a_folder() -> None:
    toy = load_scenario("clbench.testing:clbench/Toy-v0")
    brought = dataclasses.replace(toy, policy=f"{__name__}:Fixed")
    assert pretrained_folder(brought, 0) == pretrained_folder(brought, 1)
    assert pretrained_folder(toy, 0) != pretrained_folder(toy, 1)


def test_builds_of_one_version_of_a_package_share_a_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    folders = []
    for version in ("2.8.0", "2.8.0+cpu", "2.8.1"):
        monkeypatch.setattr("clbench.learning.pretraining.versions", lambda _, it=version: {"torch": it})
        folders.append(pretrained_folder(FETCH, 1))
    assert folders[0] == folders[1] != folders[2]


@pytest.mark.long
def test_the_vision_learns_from_the_pictures_of_the_questions_and_of_the_demonstrations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    toy, sizes = load_scenario("clbench.testing.seen_toy:clbench/SeenToy-v0"), list[int]()

    def count(
        vision: object, sets: Any, kinds: object, steps: int, generator: torch.Generator, *_: Any
    ) -> None:
        sizes.extend(len(one.image) for one in sets)
        assert generator.initial_seed() == torch_generator("vision", 0).initial_seed()

    monkeypatch.setattr("clbench.learning.pretraining.pretrain_vision", count)
    brief = dataclasses.replace(toy, budget=dataclasses.replace(toy.budget, pretraining_steps=1))
    pretrain(brief, 0)
    demonstrations = [load_demonstrations(task, brief, policy_config(brief)) for task in brief.retained]
    questions, _ = load_questions(brief)
    assert sizes == [len(questions.image), sum(len(one.image) for one in demonstrations)]


def test_other_seeds_are_pretrained_in_the_cache() -> None:
    assert pretrained_folder(FETCH, 1).parent == cache_folder() / "pretrained"


def test_a_torn_shipped_policy_is_not_used_and_the_log_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    torn = Path(shutil.copytree(SHIPS, tmp_path / SHIPS.name))
    about = json.loads((torn / MANIFEST).read_text(encoding="utf-8"))
    about["inputs"] = hash_of(pretraining_inputs(FETCH, 0))  # else other packages here are noticed first
    (torn / MANIFEST).write_text(json.dumps(about), encoding="utf-8")
    weights = torn / "policy.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1])
    monkeypatch.setattr("clbench.learning.pretraining.SHIPPED", tmp_path)
    assert pretrained_folder(FETCH, 0).parent == cache_folder() / "pretrained"

    def stop(*_: object) -> None:
        raise RuntimeError("pretraining began")

    monkeypatch.setattr("clbench.learning.pretraining.pretrain", stop)
    monkeypatch.setenv("CLBENCH_CACHE", str(tmp_path / "cache"))
    with pytest.raises(RuntimeError, match="pretraining began"), caplog.at_level(logging.WARNING):
        pretrained_policy(FETCH, 0)
    assert f"{torn} is torn: its files are not those that were written: pretraining" in caplog.text


def test_the_data_are_normalised_with_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    toy, threads = load_scenario("clbench.testing:clbench/Toy-v0"), list[int]()

    def normalise_like(policy: Policy, *values: Any) -> None:
        threads.append(torch.get_num_threads())

    monkeypatch.setattr(Policy, "normalise_like", normalise_like)
    brief = dataclasses.replace(toy, budget=dataclasses.replace(toy.budget, pretraining_steps=1))
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        pretrain(brief, 0)
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    assert threads == [1]


class Mute(TransformerPolicy):
    """Answers no questions."""

    abilities = frozenset()


def test_a_watcher_sees_also_a_policy_that_has_nothing_to_learn() -> None:
    toy = load_scenario("clbench.testing:clbench/Toy-v0")
    untaught = dataclasses.replace(toy, retained=(), scenes=toy.target, policy=f"{__name__}:Mute")
    steps: list[int] = []
    pretrain(untaught, 0, watch=lambda policy, step: steps.append(step))
    assert steps == [0]


@pytest.mark.usefixtures("one_thread")
def test_pretraining_repeats_itself_in_a_loop_written_out() -> None:
    toy = load_scenario("clbench.testing:clbench/Toy-v0")
    steps = 6
    brief = dataclasses.replace(
        toy,
        background=(dataclasses.replace(toy.held_out[0], name="down", instructions=("go down there",)),),
        target=toy.target[:1],
        budget=dataclasses.replace(toy.budget, pretraining_steps=steps),
    )
    config = policy_config(brief)
    known = [load_demonstrations(task, brief, config) for task in (*brief.retained, *brief.background)]
    demonstrations, (questions, _) = Demonstrations.cat(known), load_questions(brief)
    policy = new_policy(config, seed=derive_seed("weights", 5))
    policy.normalise_like(demonstrations.state, demonstrations.action[:, 0])
    optimiser = torch.optim.AdamW(policy.parameters(), betas=(0.9, 0.95), weight_decay=1e-10, fused=True)
    generator, size = torch_generator("pretraining", 5), brief.budget.batch_size
    for step in range(steps):
        # one step of warm-up, then a cosine down to a tenth
        share = 0.1 + 0.45 * (1 + math.cos(math.pi * max(0, step - 1) / (steps - 1)))
        optimiser.param_groups[0]["lr"] = brief.budget.pretraining_learning_rate * share
        loss = policy.action_loss(demonstrations.sample(size, generator)).mean()
        loss = loss + policy.answer_loss(questions.sample(size // 2, generator)).mean()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimiser.step()
    watched: list[int] = []
    made = pretrain(brief, 5, watch=lambda policy, step: watched.append(step)).state_dict()
    assert watched == [*range(steps + 1)]
    for name, value in policy.state_dict().items():
        torch.testing.assert_close(made[name], value, rtol=0, atol=1e-7)
