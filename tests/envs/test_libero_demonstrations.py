"""LIBERO's own demonstrations, imported from HDF5 files of the layout in which LIBERO publishes them."""

import dataclasses
import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("libero", reason="pip install 'clbench[libero]'")

from clbench.base.entry_points import resolve
from clbench.base.errors import InputError
from clbench.exchange.hdf5 import read_hdf5
from clbench.spec.registry import registered_scenario

Episode = resolve("clbench.envs.libero.episode:Episode")
problem_of = resolve("clbench.envs.libero.problem:problem_of")
NAME = "turn_on_the_stove"
TASK = dataclasses.replace(registered_scenario("clbench:clbench/LiberoGoal-v0").task(NAME), horizon=300)
STEPS = 12


def saved_scene(seed: int) -> str:
    """The scene as LIBERO saves it, with the fixtures where they are in an episode."""
    problem = problem_of(NAME)
    positions, quaternions = problem.start(seed)[1]
    tree = ElementTree.fromstring(problem.scene.xml)
    for element in tree.iter("body"):
        for body in problem.fixtures.values():
            if element.get("name") == problem.scene.model.body(body).name:
                element.set("pos", " ".join(map(str, positions[body])))
                element.set("quat", " ".join(map(str, quaternions[body])))
    return ElementTree.tostring(tree, encoding="unicode")


def write_demonstration(data: h5py.Group, number: int, seed: int) -> NDArray[np.float32]:
    """Write a demonstration with everything that a file of LIBERO has, and return its states here."""
    problem = problem_of(NAME)
    episode, generator = Episode(problem), np.random.default_rng(seed)
    states, theirs = [episode.begin(problem, seed)], []
    actions = generator.uniform(-1.0, 1.0, (STEPS, 7))
    actions[:, 6] = np.where(np.arange(STEPS) < STEPS / 2, -1.0, 1.0)  # opens, then closes
    for action in actions:
        now: Any = episode.data
        theirs.append(np.concatenate(([now.time], now.qpos, now.qvel)))
        episode.action = action.astype(np.float32)
        episode.move()
        states.append(episode.state())
    group = data.create_group(f"demo_{number}")
    group.attrs.update(num_samples=STEPS, model_file=saved_scene(seed), init_state=theirs[0])
    group["actions"], group["states"] = actions, np.stack(theirs)
    group["robot_states"] = np.zeros((STEPS, 9))
    group["rewards"] = group["dones"] = np.append(np.zeros(STEPS - 1, np.uint8), np.uint8(1))
    for name, width in (
        ("gripper_states", 2),
        ("joint_states", 7),
        ("ee_states", 6),
        ("ee_pos", 3),
        ("ee_ori", 3),
    ):
        group[f"obs/{name}"] = np.zeros((STEPS, width))
    for name in ("agentview_rgb", "eye_in_hand_rgb"):
        group[f"obs/{name}"] = np.zeros((STEPS, 128, 128, 3), np.uint8)
    return np.stack(states)


@pytest.fixture
def libero(tmp_path: Path) -> tuple[Path, list[NDArray[np.float32]]]:
    """A file of LIBERO, and the states of its demonstrations here, in the order of their numbers."""
    path, problem = tmp_path / f"{NAME}_demo.hdf5", {"problem_name": "libero_tabletop_manipulation"}
    words = {"domain_name": "robosuite", "language_instruction": '"turn on the stove"'}
    kwargs = {"robots": ["Panda"], "control_freq": 20, "camera_heights": 128, "ignore_done": True}
    name = "Libero_Tabletop_Manipulation"
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs.update(
            env_name=name,
            env_args=json.dumps({"type": 1, "env_name": name, **problem, "env_kwargs": kwargs}),
            problem_info=json.dumps({**problem, **words}),
            macros_image_convention="opengl",
            bddl_file_name="chiliocosm/bddl_files/libero_goal/turn_on_the_stove.bddl",
            bddl_file_content="(define (problem LIBERO_Tabletop_Manipulation))",
            tag="libero-v1",
            num_demos=3,
            total=3 * STEPS,
        )
        expected = {
            number: write_demonstration(data, number, seed) for number, seed in ((10, 3), (0, 61), (2, 7))
        }
    return path, [expected[number] for number in (0, 2, 10)]


def test_a_file_of_libero_has_the_states_and_actions_of_its_episodes(
    libero: tuple[Path, list[NDArray[np.float32]]],
) -> None:
    path, expected = libero
    episodes = read_hdf5(path, TASK)
    for episode, states in zip(episodes, expected, strict=True):
        np.testing.assert_allclose(episode.state[:-1], states[:-1], atol=1e-5)
        assert np.isnan(episode.state[-1]).all()
        assert episode.executed[:, 6].tolist() == [-1.0] * 6 + [1.0] * 6
        assert episode.reward.sum() == 1.0


def test_liberos_words_for_a_task_are_accepted_with_its_bddl_file_and_refused_with_another(
    libero: tuple[Path, list[NDArray[np.float32]]],
) -> None:
    path, _ = libero
    with h5py.File(path, "r+") as file:
        problem = {"language_instruction": "open the middle layer of the drawer"}
        file["data"].attrs["problem_info"] = json.dumps(problem)
    assert len(read_hdf5(path, TASK)) == 3
    with h5py.File(path, "r+") as file:
        file["data"].attrs["bddl_file_name"] = "libero_goal/open_the_middle_drawer_of_the_cabinet.bddl"
    with pytest.raises(
        InputError, match="its instruction is 'open the middle layer of the drawer', which the"
    ):
        read_hdf5(path, TASK)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (lambda demo: demo.attrs.pop("model_file"), "there is no model_file beside it, which says where"),
        (lambda demo: demo.attrs.update(model_file="<mujoco>"), "model_file is not XML: no element"),
        (lambda demo: demo.attrs.update(model_file="<mujoco/>"), "model_file has no body [a-z_]+_1_main"),
    ],
    ids=["missing", "damaged", "another"],
)
def test_a_demonstration_without_its_scene_is_refused(
    libero: tuple[Path, list[NDArray[np.float32]]], fault: Any, message: str
) -> None:
    path, _ = libero
    with h5py.File(path, "r+") as file:
        fault(file["data/demo_2"])
    with pytest.raises(InputError, match=f"data/demo_2/states is neither a state of the world .*{message}"):
        read_hdf5(path, TASK)


def test_a_demonstration_of_another_suite_is_refused_with_the_size_of_a_state(
    libero: tuple[Path, list[NDArray[np.float32]]],
) -> None:
    milk = "pick_up_the_milk_and_place_it_in_the_basket"
    task = registered_scenario("clbench:clbench/LiberoSpatial-v1").task(milk)
    task = dataclasses.replace(task, instructions=(*task.instructions, "turn on the stove"))
    size = problem_of(milk).starts.shape[1]
    with pytest.raises(InputError, match=f"it has 79 numbers, but a state of LIBERO has {size} in {milk}"):
        read_hdf5(libero[0], task)
