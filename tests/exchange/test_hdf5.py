"""HDF5 files: our own come back bit for bit, those of others are checked against the task."""

import dataclasses
import json
import re
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers import same_demonstrations

from clbench import export_demonstrations
from clbench.base.errors import InputError
from clbench.data.access import LeakError, hooks
from clbench.data.demonstrations import Demonstration, Demonstrations, dataset_folder, read_dataset
from clbench.exchange.hdf5 import read_hdf5
from clbench.spec.task import Task
from clbench.testing import TOY
from clbench.testing import toy as toy_module

TASK = TOY.task("right")
CAMERA = "clbench.testing.toy_camera:ToyCamera"


@pytest.fixture(scope="module")
def export(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of one task of the toy, which no test changes."""
    folder = tmp_path_factory.mktemp("export") / "out"
    return export_demonstrations(TOY, folder, format="hdf5", tasks=["right"]) / "right_demo.hdf5"


@pytest.fixture
def exported(export: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copy(export, tmp_path))


@pytest.fixture
def libero(tmp_path: Path) -> Path:
    """A file as LIBERO's, for the toy: float64, states of another simulator, and no final state."""
    path = tmp_path / "go_right_demo.hdf5"
    generator = np.random.default_rng(0)
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"type": 1, "env_kwargs": {"control_freq": 10}})
        data.attrs["problem_info"] = json.dumps({"language_instruction": '"go right"'})
        data.attrs["num_demos"], data.attrs["total"] = 12, 12 * 5
        for number in range(12):
            demo = data.create_group(f"demo_{number}")
            demo.attrs["num_samples"] = 5
            demo["actions"] = np.full((5, 2), 0.01 * number)
            demo["states"] = generator.normal(size=(5, 47))
            demo["robot_states"] = generator.normal(size=(5, 9))
            demo["rewards"] = demo["dones"] = np.array([0, 0, 0, 0, 1], np.uint8)
            demo["obs/ee_pos"] = generator.normal(size=(5, 3))
            demo["obs/gripper"] = generator.normal(size=(5, 1))
            demo["obs/agentview_rgb"] = np.zeros((5, 8, 8, 3), np.uint8)
    return path


def _without_seeds(episodes: list[Demonstration]) -> list[Demonstration]:
    """Return episodes as a file keeps them."""
    return [dataclasses.replace(episode, seed=None) for episode in episodes]


def test_an_exported_file_comes_back_bit_for_bit(exported: Path) -> None:
    before = _without_seeds(read_dataset(dataset_folder(TASK, TOY.budget)))
    after = read_hdf5(exported, TASK)
    assert same_demonstrations(after, before)
    for one, other in zip(after, before, strict=True):
        for found, expected in zip(vars(one).values(), vars(other).values(), strict=True):
            assert np.asarray(found).dtype == np.asarray(expected).dtype


@pytest.mark.parametrize(("task", "refused"), [("down", True), ("left", True), ("right", False)])
def test_a_hook_exports_no_demonstrations_that_it_must_not_read(
    task: str, refused: bool, tmp_path: Path
) -> None:
    leak = pytest.raises(LeakError, match=f"reads demonstrations of {task}")
    expected: AbstractContextManager[object] = leak if refused else nullcontext()
    with hooks(["left", "right"], ["right"]), expected:
        export_demonstrations(TOY, tmp_path / "out", format="hdf5", tasks=[task])
    assert (tmp_path / "out").exists() != refused


def test_a_file_has_the_layout_that_robomimic_reads(exported: Path) -> None:
    (*_, episode) = read_dataset(dataset_folder(TASK, TOY.budget))
    with h5py.File(exported) as file:
        data = file["data"]
        assert data.attrs["total"] == sum(data[name].attrs["num_samples"] for name in data)
        assert json.loads(data.attrs["problem_info"]) == {"language_instruction": "go right"}
        arguments = json.loads(data.attrs["env_args"])
        assert arguments["env_name"] == "clbench/toy.right-v0"
        assert arguments["env_kwargs"]["control_freq"] == 10
        demo = data["demo_9"]
        steps = demo.attrs["num_samples"]
        for name in ("actions", "dones", "rewards", "states", "obs/state"):
            assert len(demo[name]) == steps
        assert np.array_equal(demo["actions"], episode.expert[:-1])
        assert np.array_equal(demo["obs/state"], episode.state[:-1])
        assert list(demo["dones"]) == [0] * (steps - 1) + [1]


@pytest.mark.long
def test_a_file_of_a_task_with_a_camera_has_what_a_policy_sees(tmp_path: Path) -> None:
    seen = dataclasses.replace(TASK, camera=CAMERA)
    scenario = dataclasses.replace(TOY, retained=(), scenes=(seen,), target=(seen,), held_out=())
    folder = export_demonstrations(scenario, tmp_path / "out", format="hdf5")
    with h5py.File(folder / "right_demo.hdf5") as file:
        demo = file["data/demo_0"]
        assert demo["obs/image"].shape == (demo.attrs["num_samples"], 16, 16, 3)
        assert demo["obs/image"].dtype == np.uint8
        assert np.array_equal(demo["obs/state"], demo["states"][:, :1])
    before = _without_seeds(read_dataset(dataset_folder(seen, TOY.budget)))
    assert same_demonstrations(read_hdf5(folder / "right_demo.hdf5", seen), before)


def test_a_file_of_liberos_layout_is_read_in_the_order_of_its_numbers(libero: Path) -> None:
    episodes = read_hdf5(libero, TASK, ["obs/ee_pos", "obs/gripper"])
    assert [episode.executed[0, 0] for episode in episodes] == [np.float32(0.01 * n) for n in range(12)]
    with h5py.File(libero) as file:
        demo = file["data/demo_3"]
        expected = np.concatenate([demo["obs/ee_pos"], demo["obs/gripper"]], axis=1).astype(np.float32)
    episode = episodes[3]
    assert np.array_equal(episode.state[:-1], expected)
    assert np.array_equal(episode.expert[:-1], episode.executed)
    assert not episode.noisy.any()
    assert episode.success
    assert list(episode.reward) == [0, 0, 0, 0, 1]


def test_what_a_file_does_not_say_is_missing_and_reaches_no_policy(libero: Path) -> None:
    episodes = read_hdf5(libero, TASK, ["obs/ee_pos", "obs/gripper"])
    assert np.isnan(episodes[0].state[-1]).all()
    assert np.isnan(episodes[0].expert[-1]).all()
    data = Demonstrations.of_task(TASK, episodes, chunk=3)
    assert all(tensor.isfinite().all() for tensor in (data.state, data.action, data.scenes))


def _set(name: str, value: Any) -> Callable[[h5py.Group], None]:
    def edit(data: h5py.Group) -> None:
        del data[name]
        data[name] = value

    return edit


def _attribute(name: str, value: Any, group: str = "") -> Callable[[h5py.Group], None]:
    def edit(data: h5py.Group) -> None:
        (data[group] if group else data).attrs[name] = value

    return edit


def _longer(data: h5py.Group) -> None:
    for name in ("actions", "executed", "states", "rewards", "dones", "noisy"):
        rows = np.repeat(np.asarray(data["demo_0"][name]), 4, axis=0)[:13]
        _set(f"demo_0/{name}", rows)(data)


def _remove(name: str) -> Callable[[h5py.Group], None]:
    return lambda data: data.__delitem__(name)


def _moved(how: str) -> Callable[[h5py.Group], None]:
    """Return an edit that leaves the actions of a demonstration in another file, which exists."""

    def edit(data: h5py.Group) -> None:
        other = f"{data.file.filename}.other"
        actions = np.asarray(data["demo_1/actions"])
        with h5py.File(other, "w") as file:
            file["actions"] = actions
        del data["demo_1/actions"]
        if how == "link":
            data["demo_1/actions"] = h5py.ExternalLink(other, "/actions")
        elif how == "link to a link":
            data["aside"] = h5py.ExternalLink(other, "/")
            data["demo_1/actions"] = h5py.SoftLink("/data/aside/actions")
        elif how == "virtual":
            layout = h5py.VirtualLayout(actions.shape, actions.dtype)
            layout[:] = h5py.VirtualSource(other, "actions", actions.shape)
            data.create_virtual_dataset("demo_1/actions", layout)
        else:  # the raw bytes of any file
            Path(other).write_bytes(actions.tobytes())
            outside = [(other, 0, actions.nbytes)]
            data.create_dataset("demo_1/actions", actions.shape, actions.dtype, external=outside)

    return edit


def _claimed(name: str, shape: tuple[int, ...]) -> Callable[[h5py.Group], None]:
    """Return an edit that claims a shape without one number of it in the file."""

    def edit(data: h5py.Group) -> None:
        del data[name]
        data.create_dataset(name, shape, np.float64, chunks=(1, 2))

    return edit


def _all(data: h5py.Group) -> None:
    for name in list(data):
        del data[name]


def _last(value: float) -> Callable[[h5py.Group], None]:
    def edit(data: h5py.Group) -> None:
        data["demo_1/actions"][1, 0] = value

    return edit


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (_all, r"no demonstrations: the layout of robomimic and LIBERO has data/demo_0, found data"),
        (_remove("demo_1/actions"), r"data/demo_1 has no 'actions'\..* It has \['dones', 'executed', "),
        (_remove("demo_1/dones"), r"data/demo_1 has no 'dones'"),
        (
            _set("demo_1/actions", np.zeros((4, 3))),
            "width of data/demo_1/actions is 3, but the world .* needs 2",
        ),
        (
            _set("demo_1/states", np.zeros((4, 47))),
            "width of data/demo_1/states is 47, but the world .* needs 4",
        ),
        (_set("demo_1/actions", np.zeros(4)), r"demo_1/actions must be numbers \(T, N\), not float64 \(4,\)"),
        (_set("demo_1/dones", ["no"] * 4), r"demo_1/dones must be numbers \(T,\), not object \(4,\)"),
        (_set("demo_1/rewards", np.zeros(3)), "demo_1/rewards has 3 rows, but there are 4 actions"),
        (
            _set("demo_1/final_state", np.zeros(3)),
            "width of data/demo_1/final_state is 3, but the world .* needs 4",
        ),
        (_set("demo_1/final_state", [0, np.inf, 0, 0]), "column 1 of data/demo_1/final_state is inf"),
        (_set("demo_1/final_state", [np.nan, 0, 0, 0]), "column 0 of data/demo_1/final_state is nan"),
        (_set("demo_1/final_state", ["no"] * 4), r"final_state must be numbers \(N,\), not object \(4,\)"),
        (_set("demo_1/final_action", [0, 1.5]), "column 1 of data/demo_1/final_action is 1.5"),
        (
            _set("demo_1/dones", np.zeros(4)),
            "data/demo_1 does not end in success: the last of its dones is 0",
        ),
        (_set("demo_1/states", np.full((4, 4), np.nan)), "demo_1/states holds numbers that are not finite"),
        (_set("demo_1/states", np.full((4, 4), 1e300)), r"row 0, column 0 of data/demo_1/states is 1e\+300"),
        (_last(1.0000002), "row 1, column 0 of data/demo_1/actions is 1.00000024: the world"),
        (_last(1.5), r"row 1, column 0 of data/demo_1/actions is 1.5: the world .* from -1 to 1"),
        (
            _set("demo_1/actions", np.zeros((0, 2))),
            "data/demo_1 has 0 steps: it must have 1 to 12, the horizon of the task right",
        ),
        (_longer, "data/demo_0 has 13 steps: it must have 1 to 12"),
        (_attribute("num_samples", 3, "demo_1"), "demo_1 has num_samples 3, but 4 rows of actions"),
        (_attribute("num_samples", "abc", "demo_1"), "num_samples of data/demo_1 must be a whole number"),
        (_attribute("num_samples", [4, 4], "demo_1"), r"must be a whole number, not '\[4 4\]'"),
        (_attribute("num_samples", np.nan, "demo_1"), "demo_1 has num_samples nan, but 4 rows of actions"),
        (_attribute("total", 1), "data has total 1, but its demonstrations have 47 steps"),
        (_attribute("total", "unknown"), "total of data must be a whole number, not 'unknown'"),
        (_attribute("num_demos", 9), "data has num_demos 9, but 10 demonstrations"),
        (lambda data: data.copy("demo_0", "demo_00"), "data has both demo_0 and demo_00"),
        (
            lambda data: data.move("demo_1", "demo_1_retry"),
            "data also holds demo_1_retry: rename each",
        ),
        (
            lambda data: data.move("demo_1", "Demo_1"),
            "data also holds Demo_1: rename each",
        ),
        (_set("demo_0", h5py.SoftLink("/nowhere")), "data/demo_0 must be a group, not .* a broken link"),
        (_set("demo_0", h5py.ExternalLink("none.hdf5", "/data/demo_0")), "data/demo_0 must be a group"),
        *(
            (_moved(how), "data/demo_1/actions has its numbers in another file: copy them into this one")
            for how in ("link", "link to a link", "virtual", "raw")
        ),
        (
            _claimed("demo_1/actions", (10**9, 2)),
            "actions has 2,000,000,000 numbers; the limit is 10,000,000",
        ),
        (_claimed("demo_1/states", (4, 10**8)), "states has 400,000,000 numbers; the limit is 10,000,000"),
        (
            _attribute("problem_info", '{"language_instruction": [1, 2]}'),
            r"language_instruction in problem_info must be a string, not '\[1, 2\]'",
        ),
        (
            _attribute("problem_info", '{"language_instruction": "go down"}'),
            "its instruction is 'go down', which the task right does not have",
        ),
        (
            _attribute("env_args", '{"env_kwargs": {"control_freq": 20}}'),
            "recorded at 20 steps per second, but the world .* makes 10: each action would last a different "
            "time",
        ),
        (_attribute("env_args", '{"env_kwargs": {"control_freq": NaN}}'), "recorded at nan steps per second"),
    ],
)
def test_what_does_not_fit_is_named(edit: Callable[[h5py.Group], None], message: str, exported: Path) -> None:
    with h5py.File(exported, "r+") as file:
        edit(file["data"])
    with pytest.raises(InputError, match=f"^{exported}: .*{message}"):
        read_hdf5(exported, TASK)


class _OwnRate(toy_module.ToyWorld):
    """A toy whose task "right" has 5 steps per second, as its metadata say after the reset."""

    def reset(self, **arguments: Any) -> Any:
        self.metadata = {**self.metadata, "render_fps": 5}
        return super().reset(**arguments)


@pytest.mark.parametrize(("rate", "fits"), [(5, True), (10, False)])
def test_a_file_must_have_the_rate_of_its_task_in_the_world(
    rate: float, fits: bool, exported: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(toy_module, "OwnRate", _OwnRate, raising=False)
    task = dataclasses.replace(TASK, world="clbench.testing.toy:OwnRate")
    with h5py.File(exported, "r+") as file:
        _attribute("env_args", json.dumps({"env_kwargs": {"control_freq": rate}}))(file["data"])
    expected = nullcontext() if fits else pytest.raises(InputError, match=r"at 10 steps .* makes 5: each")
    with expected:
        read_hdf5(exported, task)


class _Broken(toy_module.ToyWorld):
    """A toy that cannot be reset."""

    def reset(self, **arguments: Any) -> Any:
        raise ValueError("the scene has no table")


def test_an_error_of_the_world_is_not_one_of_the_file(
    exported: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(toy_module, "Broken", _Broken, raising=False)
    with pytest.raises(ValueError, match=r"^the scene has no table$"):
        read_hdf5(exported, dataclasses.replace(TASK, world="clbench.testing.toy:Broken"))


def test_an_instruction_counts_as_a_policy_reads_it(exported: Path) -> None:
    with h5py.File(exported, "r+") as file:
        _attribute("problem_info", '{"language_instruction": "Go right!"}')(file["data"])
    assert read_hdf5(exported, TASK)


def test_the_datasets_of_the_state_are_named_with_the_nearest_one(libero: Path) -> None:
    with pytest.raises(InputError, match=r"data/demo_0 has no 'obs/ee_ps'\. Did you mean 'obs/ee_pos'\?"):
        read_hdf5(libero, TASK, ["obs/ee_ps"])
    with pytest.raises(InputError, match="width of data/demo_0/obs/ee_pos and robot_states is 12"):
        read_hdf5(libero, TASK, ["obs/ee_pos", "robot_states"])


def test_one_dataset_or_one_task_may_be_named_without_a_list(exported: Path, tmp_path: Path) -> None:
    assert same_demonstrations(read_hdf5(exported, TASK, "states"), read_hdf5(exported, TASK))
    folder = export_demonstrations(TOY, tmp_path / "one", format="hdf5", tasks="right")
    assert [path.name for path in folder.iterdir()] == ["right_demo.hdf5"]


@pytest.mark.parametrize("state", [(), ("states", ""), ("/data/demo_0/states",)])
def test_the_state_needs_the_names_of_datasets_of_a_demonstration(
    state: tuple[str, ...], exported: Path
) -> None:
    with pytest.raises(InputError, match="The state must name datasets of a demonstration, such as states"):
        read_hdf5(exported, TASK, state)


def test_a_dataset_may_be_a_link_to_another(exported: Path) -> None:
    before = read_hdf5(exported, TASK)
    with h5py.File(exported, "r+") as file:
        file.move("data/demo_1/states", "elsewhere")
        file["data/demo_1/states"] = h5py.SoftLink("/elsewhere")
    assert same_demonstrations(read_hdf5(exported, TASK), before)


def test_a_final_row_that_is_nan_throughout_is_missing(exported: Path) -> None:
    with h5py.File(exported, "r+") as file:
        file["data/demo_1/final_state"][...] = np.nan
        file["data/demo_1/final_action"][...] = np.nan
    episode = read_hdf5(exported, TASK)[1]
    assert np.isnan(episode.state[-1]).all()
    assert np.isnan(episode.expert[-1]).all()


def test_a_path_without_a_file_that_can_be_read_is_named(tmp_path: Path) -> None:
    long = tmp_path / ("x" * 300)
    for path, message in (
        (tmp_path / "x.hdf5", f"There is no file {tmp_path / 'x.hdf5'}."),
        (tmp_path, f"{tmp_path} is a folder, not an HDF5 file."),
        (long, f"{long} cannot be read: File name too long."),
    ):
        with pytest.raises(InputError, match=f"^{re.escape(message)}$"):
            read_hdf5(path, TASK)


@pytest.mark.long
def test_a_damaged_file_is_named_wherever_the_damage_is(exported: Path) -> None:
    whole = exported.read_bytes()
    generator = np.random.default_rng(0)
    messages = []
    for place in generator.integers(len(whole), size=60):
        for damaged in (whole[:place], whole[:place] + generator.bytes(64) + whole[place + 64 :]):
            exported.write_bytes(damaged)
            try:
                read_hdf5(exported, TASK)  # which may succeed: not every bit matters
            except InputError as error:
                messages.append(str(error))
    assert all(message.startswith(f"{exported}") for message in messages)
    assert sum("cannot be read as HDF5: it is damaged (" in message for message in messages) > 60


def test_a_file_of_another_format_is_named(tmp_path: Path) -> None:
    path = tmp_path / "x.hdf5"
    path.write_bytes(b"no HDF5")
    with pytest.raises(InputError, match=rf"{path} cannot be read as HDF5: it is damaged \(.* signature"):
        read_hdf5(path, TASK)


def test_a_lerobot_dataset_is_named_as_one(tmp_path: Path) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text("{}")
    with pytest.raises(InputError, match=f"^{tmp_path} is a LeRobotDataset, which clbench cannot read"):
        read_hdf5(tmp_path, TASK)


def test_attributes_that_say_nothing_are_no_fault(exported: Path) -> None:
    with h5py.File(exported, "r+") as file:
        for name in list(file["data"].attrs):
            del file["data"].attrs[name]
        file["data"].attrs["env_args"] = "[1]"
    task: Task = dataclasses.replace(TASK, instructions=("another",))
    assert len(read_hdf5(exported, task)) == 10


def test_a_place_in_which_no_folder_can_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(InputError, match="cannot be made: Not a directory"):
        export_demonstrations(TOY, tmp_path / "file" / "out", format="hdf5")
