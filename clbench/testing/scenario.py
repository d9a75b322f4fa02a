"""The check of a scenario, which must pass before a score on it means anything.

In a test:

    def test_my_scenario() -> None:
        check_scenario(load_scenario("mypackage:me/Mine-v0"))
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from clbench.base.entry_points import resolve
from clbench.base.errors import ClbenchError
from clbench.base.seeding import derive_seed
from clbench.data.demonstrations import demonstrate
from clbench.data.questions import QuestionKind
from clbench.evaluation.definition import recording_of
from clbench.spec.fields import whole_number
from clbench.spec.identifiers import check_plain, check_scenario_id
from clbench.spec.language import LENGTHS, fitting_length, word_id, word_ids
from clbench.spec.registry import load_scenario
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task
from clbench.testing.global_state import same
from clbench.worlds.lanes import Lanes, success_at_horizon
from clbench.worlds.observation import Observer
from clbench.worlds.world import World

STILL = 3
"""Number of episodes without any action; a task that succeeds in all of them needs no skill."""


class ScenarioError(AssertionError):
    """A scenario fails the check: the message names the part, the expectation and the finding."""


def check_scenario(scenario: Scenario | str, *, episodes: int = 10, success: float = 0.9) -> None:
    """Check a scenario: its worlds, every task with its expert, and its questions.

    Worlds: all have spaces of numbers, of one size in the whole scenario, and actions from -1 to 1.

    Tasks: no two have an instruction in common; the expert succeeds often enough; doing nothing fails at
    least once; `terminated` and `info["success"]` both mean success and nothing else, and come only at the
    horizon if the world declares `success_at_horizon`; observations are in their space and rewards are
    finite numbers; the initial state depends on the seed; an episode depends only on the seed and the
    actions, also after other episodes, in a new world, and side by side in a vector world.

    Cameras: each draws a first state, which needs a machine that can draw.

    Questions: all words are in the vocabulary, and every answer occurs in the experts' noisy episodes.

    Args:
        scenario: Scenario to check, or its Gymnasium id; "module:id" imports the module first.
        episodes: Number of the expert's episodes on each task, and of noisy episodes for the questions.
        success: Share of the episodes in which the expert must succeed.

    Raises:
        InputError: The number of episodes is not a whole number of at least 1.
        UnknownNameError: An entry point does not exist.
        RenderingError: A camera cannot draw.
        ScenarioError: Any other part is wrong, or its code raises an error, which is then the cause.
    """
    if isinstance(scenario, str):
        scenario = load_scenario(scenario)
    whole_number("episodes", episodes, 1)
    tasks = scenario.tasks + scenario.background
    try:
        check_scenario_id(scenario.id)
        for task in tasks:
            fitting_length(task.instructions + task.test_instructions)
    except ValueError as error:
        raise ScenarioError(f"{scenario.id}: {error}") from error
    wordings: dict[tuple[int, ...], str] = {}
    for task in tasks:
        texts = task.instructions + task.test_instructions
        for words, ids in zip(texts, word_ids(texts, LENGTHS[-1]), strict=True):
            if (other := wordings.setdefault(tuple(ids), task.name)) != task.name:
                raise ScenarioError(
                    f"{scenario.id}: {other} and {task.name} share the instruction {words!r}: a policy could "
                    "not tell them apart. Case, accents and punctuation do not count."
                )
    if not scenario.target:
        raise ScenarioError(f"{scenario.id}: there is no target to learn.")
    sizes: dict[tuple[int, ...], str] = {}
    for entry_point in dict.fromkeys(task.world for task in tasks):
        make_world: Callable[[], World] = resolve(entry_point)
        with _running(entry_point):
            world = make_world()
        with closing(world):
            state, action = _check_spaces(entry_point, world)
            sizes.setdefault((*state.shape, *action.shape), entry_point)
            for task in tasks:
                if task.world == entry_point:
                    with _running(f"task {task.name}"):
                        _check_task(task, world, episodes, success)
    if len(sizes) > 1:
        found = ", ".join(f"{name} {size}" for size, name in sizes.items())
        raise ScenarioError(
            f"{scenario.id}: states and actions must have one size in all worlds, not {found}."
        )
    for task in {task.world: task for task in tasks if task.camera}.values():  # all have the same camera
        _check_camera(task)
    _check_questions(scenario, episodes)


@contextmanager
def _running(part: str) -> Iterator[None]:
    """Turn an error that the code of a part raises into one that names the part.

    Raises:
        ScenarioError: Something other than a clause of the check failed; the error is its cause.
    """
    try:
        yield
    except (ScenarioError, ClbenchError):
        raise
    except Exception as error:
        raise ScenarioError(f"{part}: {type(error).__name__}: {error}") from error


def _check_spaces(name: str, world: World) -> tuple[spaces.Box, spaces.Box]:
    """Return the spaces of a world, if they are boxes of numbers."""
    for kind, space in (("observation", world.observation_space), ("action", world.action_space)):
        if not (isinstance(space, spaces.Box) and len(space.shape) == 1 and space.dtype == np.float32):
            raise ScenarioError(
                f"{name}: the {kind} space must be a Box of one axis of float32, not {space}."
            )
    state, action = world.observation_space, world.action_space
    assert isinstance(state, spaces.Box)
    assert isinstance(action, spaces.Box)
    if not (np.all(action.low == -1) and np.all(action.high == 1)):
        raise ScenarioError(f"{name}: actions must go from -1 to 1, as a policy's do, not {action}.")
    return state, action


class _Episode(NamedTuple):
    """An episode: states (T + 1, S), actions (T, A), and the reward and success of each step, (T,)."""

    states: NDArray[np.float32]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float64]
    successes: NDArray[np.bool_]


def _check_task(task: Task, world: World, episodes: int, success: float) -> None:
    recorded = recording_of(task) is not None
    expert = _aimless(world) if recorded else resolve(task.expert)(task.name)
    seeds = [derive_seed("check", task.name, number) for number in range(episodes)]
    played = [_play(task, world, seed, expert) for seed in seeds]
    early = [len(episode.successes) for episode in played if episode.successes[: task.horizon - 1].any()]
    if early and success_at_horizon(task):
        raise ScenarioError(
            f"task {task.name}: {task.world} declares success_at_horizon, but an episode succeeds after "
            f"{early[0]} of {task.horizon} steps: environments would call it truncated, not terminated."
        )
    share = sum(episode.successes.any() for episode in played) / episodes
    if share < success and not recorded:
        raise ScenarioError(
            f"task {task.name}: its expert {task.expert} succeeds in {share:.0%} of {episodes} episodes, not "
            f"in {success:.0%}. Correct it, the success rule or the horizon of {task.horizon} steps."
        )
    nothing = np.zeros(world.action_space.shape or (), np.float32)
    if all(_play(task, world, seed, lambda _: nothing).successes.any() for seed in seeds[:STILL]):
        raise ScenarioError(f"task {task.name}: doing nothing completes it.")
    if episodes > 1 and len({episode.states[0].tobytes() for episode in played}) == 1:
        raise ScenarioError(f"task {task.name}: all seeds have the same initial state.")
    again = _play(task, world, seeds[0], expert)
    with closing(resolve(task.world)()) as new:
        afresh = _play(task, new, seeds[0], expert)
    for other, where in ((again, "after other episodes"), (afresh, "in a new world")):
        if not same(other, played[0]):
            raise ScenarioError(
                f"task {task.name}: the same seed and actions give a different episode {where}."
            )
    _check_side_by_side(task, seeds[:2], played[:2])


def _check_camera(task: Task) -> None:
    """Draw the first state of an episode: the observer refuses numbers and pictures of another size."""
    with (
        closing(resolve(task.world)()) as world,
        closing(Observer(task.world, task.camera)) as observer,
        _running(f"camera {task.camera}"),
    ):
        state, _ = world.reset(seed=0, options={"task": task.name})
        observer.observe(state[None])


def _aimless(world: World) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    """Return an aimless expert, for tasks without one: a state always gives the same random action."""

    def act(state: NDArray[np.float32]) -> NDArray[np.float32]:
        generator = np.random.default_rng(np.frombuffer(state.tobytes(), np.uint8))
        return generator.uniform(-1, 1, world.action_space.shape).astype(np.float32)

    return act


def _play(task: Task, world: World, seed: int, act: Any) -> _Episode:
    """Run an episode, and check that the world keeps its rules."""
    state, info = world.reset(seed=seed, options={"task": task.name})
    states, actions, rewards, successes, done = [state], [], [], [], False
    for step in range(task.horizon + 1):
        where = f"task {task.name}, step {step}"
        if (
            not isinstance(state, np.ndarray)  # Gymnasium would take a list for an array
            or not world.observation_space.contains(state)
            or not np.isfinite(state).all()
        ):
            kind = f"{getattr(state, 'dtype', type(state).__name__)} of shape {np.shape(state)}"
            raise ScenarioError(
                f"{where}: the state is not in {world.observation_space}, or not finite: it is {kind}."
            )
        if bool(info.get("success", False)) != bool(done):
            raise ScenarioError(f'{where}: terminated is {done}, info["success"] is {info.get("success")}.')
        if done or step == task.horizon:
            break
        action = np.asarray(act(state), np.float32)
        if action.shape != world.action_space.shape or not np.isfinite(action).all():
            found = f"{action}, of shape {action.shape}"
            place = f"{world.action_space}, without NaN"
            raise ScenarioError(f"{where}: the action of {task.expert} must be in {place}, not {found}.")
        actions.append(action.clip(-1, 1))
        state, reward, done, truncated, info = world.step(actions[-1])
        if truncated:
            raise ScenarioError(f"{where}: the world truncates, but only the task's horizon may do so.")
        if np.shares_memory(state, states[-1]):
            raise ScenarioError(
                f"{where}: the world changed its last state in place and returned it: return a copy."
            )
        states.append(state)
        number = np.asarray(reward, np.float64)  # None becomes NaN
        if number.ndim or not np.isfinite(number):
            raise ScenarioError(f"{where}: the reward is {reward}, but must be a finite number.")
        rewards.append(float(reward))
        successes.append(bool(done))
    return _Episode(np.array(states), np.array(actions), np.array(rewards), np.array(successes))


def _check_side_by_side(task: Task, seeds: list[int], alone: list[_Episode]) -> None:
    """Check that episodes in lanes equal episodes in the plain world."""
    lanes = list(range(len(seeds)))
    with closing(Lanes(len(seeds))) as places:
        first = places.reset(lanes, seeds, [task] * len(seeds))
        equal = np.array_equal(first, [episode.states[0] for episode in alone])
        for step in range(max(len(episode.actions) for episode in alone)):
            going = [lane for lane in lanes if step < len(alone[lane].actions)]
            episodes = [alone[lane] for lane in going]
            found = places.step(going, np.stack([one.actions[step] for one in episodes]))
            rows = [(one.states[step + 1], one.rewards[step], one.successes[step]) for one in episodes]
            equal = equal and same(found, tuple(np.array(column) for column in zip(*rows, strict=True)))
    if not equal:
        raise ScenarioError(
            f"task {task.name}: its episodes in parallel lanes differ from its episodes in a single "
            f"{task.world}."
        )


# ---- questions ---------------------------------------------------------------------------------------------


def _check_questions(scenario: Scenario, episodes: int) -> None:
    kinds: tuple[QuestionKind, ...] = resolve(scenario.questions)
    if not isinstance(kinds, tuple) or not all(isinstance(kind, QuestionKind) for kind in kinds):
        raise ScenarioError(f"{scenario.questions} must be a tuple of QuestionKinds, not {kinds!r}.")
    if len({kind.name for kind in kinds}) != len(kinds) or not kinds:
        raise ScenarioError(f"{scenario.questions}: there must be questions, each kind with its own name.")
    scenes = np.concatenate(list(_scenes(scenario, episodes)))
    for kind in kinds:
        where = f"question {kind.name}"
        try:
            check_plain("kind of question", kind.name)
            fitting_length(tuple(kind.wordings))
            for answer in kind.answers:
                word_id(answer)
        except ValueError as error:
            raise ScenarioError(f"{where}: {error}") from error
        if len(set(kind.answers)) < 2:
            raise ScenarioError(f"{where}: it must have two answers or more, not {kind.answers}.")
        with _running(where):
            answers = np.asarray(kind.answer(scenes))
        if answers.shape != scenes.shape[:1] or answers.dtype.kind != "i":
            raise ScenarioError(f"{where}: the answers to states (N, S) must be whole numbers (N,).")
        if answers.min() < -1 or answers.max() >= len(kind.answers):
            raise ScenarioError(f"{where}: answers must be from -1 to {len(kind.answers) - 1}.")
        never = [word for number, word in enumerate(kind.answers) if not np.any(answers == number)]
        if never:
            raise ScenarioError(f"{where}: in {len(scenes):,} states {never[0]!r} is never the answer.")


def _scenes(scenario: Scenario, episodes: int) -> Iterator[NDArray[np.float32]]:
    """Yield states (T, S) for questions, from episodes of the tasks whose states are asked about."""
    for task in scenario.scene_tasks:
        world: gymnasium.Env[Any, Any] = resolve(task.world)()
        with closing(world):
            for number in range(episodes):
                seed = derive_seed("check scene", task.name, number)
                with _running(f"a noisy episode of task {task.name}"):
                    state = demonstrate(world, task, seed, True).state
                yield state
