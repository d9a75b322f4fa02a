"""The observations of a policy: states, or a camera's pictures and numbers."""

import dataclasses
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from helpers import blocks_of, build_method
from numpy.typing import NDArray

from clbench.base.cache import cache_folder
from clbench.data.questions import load_questions
from clbench.evaluation.rollouts import Evaluator
from clbench.learning.optimise import deterministic, optimise
from clbench.learning.pretraining import policy_config, pretrained_policy, pretraining_inputs
from clbench.learning.registry import method_names
from clbench.learning.trainer import Trainer
from clbench.policy.transformer import TransformerPolicy
from clbench.spec.registry import load_scenario
from clbench.testing import ToyWorld
from clbench.testing.seen_toy import SEEN_TOY
from clbench.testing.toy_camera import ToyCamera
from clbench.worlds.camera import VIEW_SIZE, load_camera
from clbench.worlds.gl_backend import RenderingError
from clbench.worlds.lanes import Lanes
from clbench.worlds.observation import TOGETHER, Observer, frame_hash, observed
from clbench.worlds.perturbation import draw_perturbation

PAGE = Path(__file__).parents[2] / "docs" / "guide" / "pixels.md"
TOY = load_scenario("clbench.testing:clbench/Toy-v0")
TASK = SEEN_TOY.retained[0]
SHORT = dataclasses.replace(
    SEEN_TOY,
    target=SEEN_TOY.target[:1],
    budget=dataclasses.replace(SEEN_TOY.budget, pretraining_steps=5, adaptation_steps=2),
)
FEWER = {"aegis": {"samples": 8}, "ewc": {"samples": 4}, "fast_dvla": {"steps": 3}}
"""Hyper-parameters that make a long preparation short."""


def _states(count: int) -> NDArray[np.float32]:
    return np.random.default_rng(0).uniform(-1.0, 1.0, (count, 4)).astype(np.float32)


def test_without_a_camera_states_are_shown_as_they_are() -> None:
    states = _states(3)
    numbers, images = Observer(TASK.world, None).observe(states)
    assert np.array_equal(numbers, states)
    assert images.shape == (3, 0, 0, 3)
    assert frame_hash(TOY.retained[0]) is None


def test_a_camera_that_lacks_something_is_refused_by_name() -> None:
    with pytest.raises(
        TypeError, match=r"ToyWorld is no camera: it lacks .*pictured.* docs/guide/pixels\.md shows"
    ):
        Observer(TASK.world, "clbench.testing.toy:ToyWorld")


def test_the_camera_that_the_guide_shows_is_one(write_module: Callable[[str, str], None]) -> None:
    (shown,) = blocks_of(PAGE, "python")
    write_module("camera_of_the_guide", shown)
    camera = load_camera("camera_of_the_guide:MyCamera")
    states = np.zeros((3, 10), np.float32)
    assert camera.image_size == 64
    assert camera.proprioception(states).shape == (3, camera.state_size) == (3, 4)
    assert camera.pictured(states).shape == (3, 6)


@pytest.fixture
def camera_of(write_module: Callable[[str, str], None]) -> Callable[[str], str]:
    """Return a function that writes the toy's camera with other lines, and returns its entry point."""

    def write(lines: str) -> str:
        head = (
            "import numpy as np\nfrom clbench.testing.toy_camera import ToyCamera\nclass Other(ToyCamera):\n"
        )
        write_module("other_camera", head + lines)
        sys.modules.pop("other_camera", None)  # another test's module
        return "other_camera:Other"

    return write


@pytest.mark.parametrize(
    ("returned", "said"),
    [
        ("np.zeros((len(states), 16, 16, 3))", "of float64"),  # eight bytes for each that is read
        ("np.zeros((len(states), 8, 8, 3), np.uint8)", r"\(3, 8, 8, 3\)"),  # the rest would never come
    ],
)
def test_pictures_of_another_size_or_kind_are_refused(
    camera_of: Callable[[str], str], returned: str, said: str
) -> None:
    camera = camera_of(f"    def draw(self, states, views): return {returned}\n")
    observer = Observer(TASK.world, camera)
    with pytest.raises(
        RenderingError, match=rf"draw\(\) must return \(3, 16, 16, 3\) of uint8, not .*{said}"
    ):
        observer.observe(_states(3))
    observer.close()


def test_numbers_of_another_size_are_refused(camera_of: Callable[[str], str]) -> None:
    camera = camera_of("    proprioception = staticmethod(lambda states: states[:, :3])\n")
    with pytest.raises(TypeError, match=r"proprioception\(\) must return \(3, 1\), not \(3, 3\)"):
        Observer(TASK.world, camera).observe(_states(3))


def test_where_the_source_of_the_camera_changes_the_policy_is_pretrained_anew(
    camera_of: Callable[[str], str],
) -> None:
    def inputs(column: int) -> Any:
        camera = camera_of(
            f"    proprioception = staticmethod(lambda states: states[:, {column} : {column + 1}])\n"
        )
        groups: dict[str, Any] = {
            group: tuple(dataclasses.replace(task, camera=camera) for task in getattr(SEEN_TOY, group))
            for group in ("retained", "target", "held_out")
        }
        return pretraining_inputs(dataclasses.replace(SEEN_TOY, **groups), 0)

    assert inputs(0) != inputs(1)


def test_processes_draw_the_cameras_pictures_in_the_order_of_the_states() -> None:
    states = _states(2 * TOGETHER + 3)
    views = np.zeros((len(states), VIEW_SIZE), np.float32)
    views[::2] = np.random.default_rng(1).uniform(-1.0, 1.0, views[::2].shape)
    observer = Observer(TASK.world, TASK.camera, processes=2)
    numbers, images = observer.observe(states)
    perturbed = observer.observe(states, views)[1]
    one = observer.observe(states[:1])[1]
    observer.close()
    assert np.array_equal(numbers, states[:, :1])
    assert np.array_equal(images, ToyCamera().draw(states, np.zeros_like(views)))
    assert np.array_equal(perturbed, ToyCamera().draw(states, views))
    assert np.array_equal(one, images[:1])


def test_pictures_change_in_perturbed_episodes_alone() -> None:
    lanes = Lanes(3)
    seeds, tasks = [3, 3, 3], [TASK] * 3
    states = lanes.reset(range(3), seeds, tasks, [True, False, True])
    drawn = draw_perturbation(3).view
    expected = ToyCamera().draw(states, np.array([drawn, [0.0] * VIEW_SIZE, drawn], np.float32))
    _, images = lanes.observe(range(3), tasks, states)
    assert np.array_equal(images, expected)
    lanes.reset([0], [3], [TASK])
    _, (again,) = lanes.observe([0], [TASK], states[1:2])
    lanes.close()
    assert np.array_equal(again, images[1])


@pytest.mark.long
def test_each_lane_is_seen_through_the_camera_of_its_task_with_the_view_of_its_seed(
    camera_of: Callable[[str], str],
) -> None:
    camera = camera_of("    proprioception = staticmethod(lambda states: states[:, 1:2])\n")
    other = dataclasses.replace(TASK, camera=camera)
    lanes = Lanes(4)
    views = {3: draw_perturbation(5).view, 0: draw_perturbation(3).view, 2: [0.0] * VIEW_SIZE}
    started = lanes.reset([3, 0, 2], [5, 3, 4], [TASK, other, TASK], [True, True, False])
    states = dict(zip([3, 0, 2], started, strict=True))
    for shown, tasks, columns in (([0, 2, 3], [other, TASK, TASK], [1, 0, 0]), ([2, 3], [TASK] * 2, [0, 0])):
        rows = np.stack([states[lane] for lane in shown])
        numbers, images = lanes.observe(shown, tasks, rows)
        assert numbers[:, 0].tolist() == [row[column] for row, column in zip(rows, columns, strict=True)]
        expected = ToyCamera().draw(rows, np.array([views[lane] for lane in shown], np.float32))
        assert np.array_equal(images, expected)
    lanes.close()


@pytest.mark.long
def test_pictures_of_a_data_set_are_drawn_once(empty_caches: Path) -> None:
    first = observed(TASK, _states(5))
    (file,) = cache_folder().rglob("frames.safetensors")
    written = file.stat().st_mtime_ns
    again = observed(TASK, _states(5))
    other = observed(TASK, _states(6))
    assert np.array_equal(first[0], again[0])
    assert np.array_equal(first[1], again[1])
    assert file.stat().st_mtime_ns == written
    assert other[1].shape == (6, 16, 16, 3)
    assert len(list(cache_folder().rglob("frames.safetensors"))) == 2


def test_each_data_set_has_its_own_pictures_also_if_it_has_the_size_of_another(empty_caches: Path) -> None:
    states = _states(10)
    for some in (states[:5], states[5:]):
        numbers, images = observed(TASK, some)
        assert np.array_equal(numbers, some[:, :1])
        assert np.array_equal(images, ToyCamera().draw(some, np.zeros((5, VIEW_SIZE), np.float32)))


def test_where_the_source_of_the_camera_changes_a_data_set_is_observed_anew(
    camera_of: Callable[[str], str], empty_caches: Path
) -> None:
    states = _states(5)
    for columns, shown in (("-1:", states[:, -1:]), (":1", states[:, :1])):
        lines = f"    proprioception = staticmethod(lambda states: states[:, {columns}])\n"
        numbers, _ = observed(dataclasses.replace(TASK, camera=camera_of(lines)), states)
        assert np.array_equal(numbers, shown)


@pytest.mark.long
def test_where_another_renderer_draws_a_data_set_is_observed_anew(
    empty_caches: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    observed(TASK, _states(5))
    monkeypatch.setattr("clbench.worlds.observation.frame_hash", lambda _: "of another renderer")
    observed(TASK, _states(5))
    assert len(list(cache_folder().rglob("frames.safetensors"))) == 2


def test_a_process_that_dies_is_named_with_its_last_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "dim.py").write_text(
        "from clbench.testing.toy_camera import ToyCamera\n"
        "class Dim(ToyCamera):\n"
        "    def draw(self, states, views): raise RuntimeError('no light')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]))
    observer = Observer(TASK.world, "dim:Dim")
    with pytest.raises(RenderingError, match="drawing process of dim:Dim has ended: RuntimeError: no light"):
        observer.observe(_states(2))
    observer.close()


def test_where_nothing_draws_the_error_names_the_packages_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr("clbench.worlds.gl_backend.rendering_fault", lambda *_: "no driver")
    with pytest.raises(RenderingError, match=r"\(no driver\).*apt-get install"):
        Observer("clbench.testing.toy:ToyWorld", TASK.camera).observe(_states(1))


@pytest.mark.filterwarnings("ignore:.*(minimum|maximum) value.*infinity.*")
def test_an_agent_of_the_scenario_sees_the_picture_and_no_more() -> None:
    env = gymnasium.make(SEEN_TOY.id, instruction="tokens", disable_env_checker=True)
    check_env(env.unwrapped, skip_render_check=True)
    observation, _ = env.reset(seed=4)
    many = gymnasium.make_vec(SEEN_TOY.id, num_envs=2, instruction="tokens")
    side_by_side, _ = many.reset(seed=4)
    assert observation["state"].shape == (1,)
    assert observation["image"].shape == (16, 16, 3)
    for name, value in observation.items():
        assert np.array_equal(side_by_side[name][0], value)
    many.close()
    env.close()


@pytest.mark.long
def test_a_policy_learns_facts_that_only_the_picture_shows() -> None:
    policy = TransformerPolicy(policy_config(SEEN_TOY), seed=0)
    assert (policy.config.state_size, policy.config.image_size) == (1, 16)
    asked = load_questions(SEEN_TOY)[0].sample(32, torch.Generator().manual_seed(0))
    asked = dataclasses.replace(asked, state=torch.zeros_like(asked.state))
    blind = dataclasses.replace(asked, image=torch.zeros_like(asked.image))
    with deterministic():
        optimise(policy.parameters(), 2e-3, 150, lambda _: policy.answer_loss(asked).mean())
    assert policy.answer_loss(asked).mean() < 0.2
    assert policy.answer_loss(blind).mean() > 0.5


@pytest.mark.long
def test_an_outcome_does_not_depend_on_what_else_is_seen() -> None:
    policy, _ = pretrained_policy(SHORT, 0)
    evaluator = Evaluator(SHORT, seed=0)
    together = evaluator.evaluate(policy.eval(), SHORT.tasks)
    alone = evaluator.evaluate(policy, SHORT.tasks[1:2])
    evaluator.close()
    assert together[4:8] == alone


@pytest.mark.parametrize("name", method_names())
def test_every_method_learns_from_pictures(name: str, tmp_path: Path) -> None:
    trainer = Trainer.open(SHORT, lambda: build_method(name, FEWER.get(name, {})), 0, "cpu")
    trainer.prepare()
    trainer.save(tmp_path / "0", trainer.state(0))
    trainer.load(tmp_path / "0", 0)
    trainer.learn(1, lambda _: None)
    assert trainer.policy.config == policy_config(SEEN_TOY)
    trainer.save(tmp_path / "1", trainer.state(1))
    trainer.load(tmp_path / "1", 1)


@pytest.mark.long
def test_after_an_interruption_the_next_picture_is_that_of_its_own_state(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    observer, states = Observer(TASK.world, TASK.camera), _states(2)
    _, expected = observer.observe(states)
    assert not np.array_equal(expected[0], expected[1])
    answer = type(observer._processes[0]).answer

    def interrupted(process: Any) -> Any:
        monkeypatch.setattr(type(process), "answer", answer)
        raise KeyboardInterrupt

    monkeypatch.setattr(type(observer._processes[0]), "answer", interrupted)
    with pytest.raises(KeyboardInterrupt):
        observer.observe(states[:1])
    _, images = observer.observe(states[1:])
    assert np.array_equal(images, expected[1:])
    observer.close()


FORKED = f"""
import os, signal, time
import numpy as np
from clbench.worlds import observation
from clbench.worlds.observation import Observer

observation.working_back_end = lambda *_: "egl"  # the toy draws by itself
states = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 4)).astype(np.float32)
observer = Observer({TASK.world!r}, {TASK.camera!r})
_, expected = observer.observe(states)
"""


def _run_forked(code: str) -> None:
    # a process of its own: pytest and its workers have threads
    subprocess.run([sys.executable, "-W", "ignore", "-c", FORKED + code], check=True, timeout=100)


def test_closing_does_not_wait_for_a_process_that_was_forked_after_the_first_picture() -> None:
    _run_forked("""
child = os.fork()
if not child:
    time.sleep(20)
    os._exit(0)
observer.close()
assert os.waitpid(child, os.WNOHANG) == (0, 0), "it has ended first"
os.kill(child, signal.SIGKILL)
""")


def test_a_forked_process_draws_its_own_states_even_while_the_first_one_waits_for_a_picture() -> None:
    _run_forked("""
Drawing = observation._DrawingProcess
answer = Drawing.answer
def fork_and_answer(process):
    Drawing.answer = answer
    child = os.fork()
    if not child:
        same = np.array_equal(observer.observe(states[1:])[1], expected[1:])
        observer.close()
        os._exit(0 if same else 1)
    assert os.waitpid(child, 0)[1] == 0
    return answer(process)
Drawing.answer = fork_and_answer
assert np.array_equal(observer.observe(states[:1])[1], expected[:1])
assert np.array_equal(observer.observe(states)[1], expected)
observer.close()
""")


def test_a_process_that_does_not_end_is_killed(
    camera_of: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("clbench.worlds.observation._PATIENCE", 0.1)
    camera = camera_of("    def draw(self, states, views): import time; time.sleep(20)\n")
    observer = Observer(TASK.world, camera)

    def interrupted(process: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr("clbench.worlds.observation._DrawingProcess.answer", interrupted)
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        observer.observe(_states(1))
    assert time.monotonic() - begun < 15


class Undrawn(ToyWorld):
    """A world without a picture of its own."""

    def render(self) -> Any:
        raise NotImplementedError


@pytest.mark.long
def test_a_camera_draws_a_world_that_cannot_draw_itself() -> None:
    observer, states = Observer(f"{__name__}:Undrawn", TASK.camera), _states(1)
    _, images = observer.observe(states)
    observer.close()
    assert np.array_equal(images, ToyCamera().draw(states, np.zeros((1, VIEW_SIZE), np.float32)))
