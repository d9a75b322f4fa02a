"""One run: scenario x method x seed, from the pretrained policy to a record."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file

from clbench.activations import Gaussian
from clbench.adaptation import adapt
from clbench.cache import cache_folder, cached, hash_of, hash_of_tensors, is_cached, package_of, source_hash
from clbench.demonstrations import Demonstrations, load_demonstrations
from clbench.evaluation import Episode, Evaluator, Trial, answer
from clbench.fingerprint import fingerprint
from clbench.method import Access, Method, Prior, Source, Stage, State, build_method
from clbench.policy import load_policy, save_policy
from clbench.pretraining import pretrained_policy, pretraining_inputs
from clbench.questions import load_questions, report_questions
from clbench.record import Record, RecordError, label_of, read_record, record_path, write_record
from clbench.seeding import derive_seed, seeded, torch_generator
from clbench.task import Scenario, Split, load_scenario
from clbench.training import deterministic

EPISODE_WEIGHT = 0.3
"""What an evaluation episode takes, in optimiser steps; for the time left that a progress bar shows."""


SPARSITY_THRESHOLD = 1e-3
"""Relative change below which a weight counts as unchanged: ConSFT (arXiv 2605.08879), Eq. 8."""


@dataclass(frozen=True)
class RunSpec:
    """What is run."""

    scenario: str
    """Gymnasium id of the scenario."""
    method: str
    """Name of an installed method, or "module:Class"."""
    seed: int
    """Of every draw of the run."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Hyper-parameters that differ from the method's own."""
    device: str = "cpu"
    """Where the policy is computed."""
    split: Split = "report"
    """Which episodes it is evaluated on; those of "selection" may be looked at to choose settings."""
    targets: int | None = None
    """How many targets are learned, from the first; all if None."""

    def path(self, records: Path) -> Path:
        """Return where the record lies below the folder `records`."""
        return record_path(records, self.scenario.rpartition(":")[2], self.label, self.seed)

    def load(self) -> Scenario:
        """Return the scenario, with the targets that are learned."""
        scenario = load_scenario(self.scenario)
        return dataclasses.replace(scenario, target=scenario.target[: self.targets])

    @property
    def label(self) -> str:
        """The method and what was changed of it, as "experience_replay+replay=0.02"."""
        return label_of(self.method, self.changes)


def execute(spec: RunSpec, records: Path, progress: Callable[[float], None] = lambda _: None) -> Record:
    """Run `spec`, or go on where an interrupted run of it stopped, and write its record.

    A run that fails leaves a record of status "failed" that says where.

    Args:
        spec: What to run.
        records: Folder of the records.
        progress: Called with the optimiser steps, or what took as long, that were done since its last call;
            `run_length` says how many there are.
    """
    if spec.device != "cpu":
        # without it cuBLAS may choose another kernel each time, and PyTorch refuses to be deterministic
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    with deterministic():
        run = _Run(spec, records, progress)
        record = run.go()
    write_record(record, spec.path(records))
    run.forget()
    return record


def has_record(spec: RunSpec, records: Path) -> bool:
    """Return whether this very run went through before.

    One that failed, that cannot be read, or that is of another budget, device or settings does not count.
    """
    try:
        record = read_record(spec.path(records))
    except RecordError:
        return False
    scenario = spec.load()
    method = build_method(spec.method, spec.changes)
    wanted = (_describe_run(spec, scenario, method), _describe_scenario(scenario))
    return record.status == "success" and (record.run, record.scenario) == wanted


def _describe_run(spec: RunSpec, scenario: Scenario, method: Method) -> dict[str, Any]:
    """Return `Record.run`."""
    values = dataclasses.asdict(method)  # type: ignore[call-overload]
    settings = {name: _plain(value) for name, value in values.items()}
    return {
        "scenario": scenario.id,
        "method": spec.method,
        "seed": spec.seed,
        "device": spec.device,
        "split": spec.split,
        "settings": settings,
        "changes": {name: settings[name] for name in sorted(spec.changes)},
        "uses": dataclasses.asdict(method.uses),
    }


def _describe_scenario(scenario: Scenario) -> dict[str, Any]:
    """Return `Record.scenario`."""
    groups = ("retained", "target", "held_out")
    return {
        "id": scenario.id,
        **{group: [task.name for task in getattr(scenario, group)] for group in groups},
        "evaluation_steps": list(scenario.budget.evaluation_steps),
        "budget": dataclasses.asdict(scenario.budget),
    }


def _plain(value: Any) -> Any:
    """Return a value as JSON holds it; what it cannot hold becomes text."""
    try:
        return json.loads(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError):
        return repr(value)


def run_length(scenario: Scenario, split: Split = "report") -> float:
    """Return how long a run that is evaluated on `split` takes, in optimiser steps."""
    budget, stages, retained = scenario.budget, len(scenario.target), len(scenario.retained)
    points = len(budget.evaluation_steps)
    scored = split == "report"
    ends = (stages + 1) * len(scenario.tasks) * budget.episodes(split)
    on_the_way = stages * (points - 1) * (retained + 1)
    on_the_way *= budget.curve_episodes if scored else budget.selection_episodes
    selection = stages * points * budget.selection_episodes if scored else 0
    episodes = ends + on_the_way + selection
    return stages * budget.adaptation_steps + EPISODE_WEIGHT * episodes


def check_device(device: str) -> None:
    """Refuse a device that is not here.

    Raises:
        ValueError: The name is none that PyTorch knows, or this machine has no such device.
    """
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(f"The device {device!r} cannot be used: {reason}") from error


class _Run:
    """A run on its way: the policy, the method's data, and the record so far.

    Each stage begins with what the last one saved: a policy from its checkpoint and a new object of the
    method that was given its state. An interrupted run therefore goes on as one that was not.
    """

    def __init__(self, spec: RunSpec, records: Path, progress: Callable[[float], None]) -> None:
        self.spec, self.progress = spec, progress
        self.scenario = scenario = spec.load()
        self.method = build_method(spec.method, spec.changes)
        self.where = "start"
        self.evaluator = Evaluator(scenario, spec.seed)
        self.policy, self.pretrained = pretrained_policy(scenario, spec.seed)
        self.policy.to(spec.device)
        self.data = {
            task.name: load_demonstrations(task, scenario, self.policy.config)
            for task in scenario.retained + scenario.target
        }
        self.questions, report = load_questions(scenario)
        scored = report if spec.split == "report" else self.questions
        self.asked = report_questions(scored, scenario.budget.report_questions)
        self.weights = {name: value.clone() for name, value in self.policy.named_parameters()}
        self.anchor = self._activations()
        self.begin, self.seconds_before = time.perf_counter(), 0.0
        self.record = self._new_record()
        # two commands may do the same run for different folders at once
        key = {**self._inputs(0), "records": str(records.resolve())}
        self.checkpoints = cache_folder() / "runs" / hash_of(key)

    def go(self) -> Record:
        """Go through all stages that no checkpoint holds, and return the record."""
        self.record.timing["started"] = datetime.now(UTC).isoformat(timespec="seconds")
        try:
            self._go_through()
        except Exception as error:
            self.record.status = "failed"
            self.record.error = {
                "where": self.where,
                "type": type(error).__name__,
                "message": str(error),
                "traceback": traceback.format_exc(),
            }
        finally:
            self.evaluator.close()
        self._count_seconds()
        return self.record

    def forget(self) -> None:
        """Remove the checkpoints, once the record is written."""
        shutil.rmtree(self.checkpoints, ignore_errors=True)

    def _go_through(self) -> None:
        done = self._resume()
        if done is None:
            done = 0
            self._prepare()
            self._save(0)
        for number in range(done + 1, len(self.scenario.target) + 1):
            self._load(number - 1)
            self._stage(number)
            self._save(number)
        self._load(len(self.scenario.target))
        self._count_costs()

    def _prepare(self) -> None:
        """Let the method prepare, and evaluate what there is before any target."""
        self.where = "prepare"
        prior = self._prior(0, ("prepare", "throughout"))
        begin = time.perf_counter()
        with seeded("method", self.spec.seed, 0):
            steps = self.method.prepare(self.policy, prior) or 0
        prior.close()
        self.record.timing["preparation"] = round(time.perf_counter() - begin, 2)
        self.record.costs["preparation_steps"] = steps
        self.record.costs["optimiser_steps"] += steps
        self._report_start()
        self._diagnose(0)

    def _report_start(self) -> None:
        """Evaluate the policy before any target; the report is kept, as most methods start with the same."""
        tables = ("episodes", "answers", "policy")

        def write(folder: Path) -> None:
            self._report(0, 0)
            values = {name: getattr(self.record, name) for name in tables}
            (folder / "report.json").write_text(json.dumps(values), encoding="utf-8")

        inputs = {
            "policy": hash_of_tensors(self.policy.state_dict()),
            "scenario": self.record.scenario,
            "spec": [self.spec.seed, self.spec.device, self.spec.split],
            **self._sources(),
        }
        folder = cache_folder() / "reports" / hash_of(inputs)
        if is_cached(folder, inputs):
            count = self.scenario.budget.episodes(self.spec.split)
            self.progress(EPISODE_WEIGHT * len(self.scenario.tasks) * count)
        cached(folder, inputs, write)
        for name, value in json.loads((folder / "report.json").read_text(encoding="utf-8")).items():
            setattr(self.record, name, value)

    def _stage(self, number: int) -> None:
        """Adapt to target `number`, evaluating on the way and at the end."""
        seed, budget, task = self.spec.seed, self.scenario.budget, self.scenario.target[number - 1]
        points = () if self.method.whole_stages else budget.evaluation_steps[:-1]
        begin, evaluating = time.perf_counter(), 0.0

        def evaluate(step: int) -> None:
            nonlocal evaluating
            paused = time.perf_counter()
            self._report(number, step)
            evaluating += time.perf_counter() - paused

        def after(step: int) -> None:
            self.progress(1)
            if step in points:
                evaluate(step)

        self.where = f"stage {number} ({task.name})"
        target = self._source("target", number, self.data[task.name])
        prior = self._prior(number, ("throughout",))
        method_seed = derive_seed("method", seed, number)
        stage = Stage(number, task, method_seed, budget.adaptation_steps, target, prior)
        with seeded("method", seed, number):
            steps = adapt(self.policy, self.method, stage, budget, after)
        target.close()
        prior.close()
        evaluate(budget.adaptation_steps)
        self._diagnose(number)
        training = time.perf_counter() - begin - evaluating
        self.record.costs["optimiser_steps"] += steps
        self.record.timing["stages"].append(
            {"training": round(training, 2), "evaluation": round(evaluating, 2)}
        )

    def _diagnose(self, number: int) -> None:
        """Keep what the method tells about stage `number`."""
        self.where = f"diagnostics() after stage {number}"
        found = _checked(self.method.diagnostics())
        if found:
            self.record.diagnostics[str(number)] = found

    def _source(self, name: str, number: int, data: Any) -> Source[Any]:
        """Return data with its own random stream: what one source draws does not move another's draws."""
        generator = torch_generator(name, self.spec.seed, number)
        return Source(data, generator, self.scenario.budget.batch_size, self.spec.device)

    def _prior(self, number: int, when: tuple[Access, ...]) -> Prior:
        """Return the prior data that the method declares for the seams of stage `number`."""
        sources = {}
        if self.method.uses.demonstrations in when:
            before = self.scenario.retained + self.scenario.target[: max(0, number - 1)]
            demonstrations = Demonstrations.cat([self.data[task.name] for task in before])
            sources["demonstrations"] = self._source("prior demonstrations", number, demonstrations)
        if self.method.uses.questions in when:
            sources["questions"] = self._source("prior questions", number, self.questions)
        return Prior(sources)

    def _report(self, number: int, step: int) -> None:
        """Evaluate the policy after `step` steps of stage `number` into the record.

        At the end of a stage that is everything; on the way only what the stage can show: the skills that it
        may forget and the target that it learns.
        """
        split, budget = self.spec.split, self.scenario.budget
        at_the_end = step in (0, budget.adaptation_steps)
        target = self.scenario.target[number - 1 : number] if number else ()
        tasks = self.scenario.tasks if at_the_end else self.scenario.retained + target
        count = budget.curve_episodes if split == "report" and not at_the_end else budget.episodes(split)
        trials: list[Trial] = [(task, split, episode) for task in tasks for episode in range(count)]
        if split == "report":
            trials += [(task, "selection", n) for task in target for n in range(budget.selection_episodes)]
        self._play(number, step, trials)
        kind, questions = self.asked
        for name, asked, correct in answer(self.policy, self.questions.kinds, kind, questions):
            _append(self.record.answers, (number, step, name, asked, correct))
        drift = float(self._activations().distance(self.anchor).mean())
        _append(self.record.policy, (number, step, self._update_sparsity(), drift))

    def _play(self, number: int, step: int, trials: list[Trial]) -> None:
        self.policy.eval()
        outcomes = self.evaluator.play(
            self.policy, trials, lambda count: self.progress(EPISODE_WEIGHT * count)
        )
        self.policy.train()
        for episode in outcomes:
            _append(self.record.episodes, _episode_row(number, step, episode))

    @torch.no_grad()
    def _activations(self) -> Gaussian:
        """Return where the hidden states of the scored questions lie."""
        questions = self.asked[1].to(self.spec.device)
        hidden = self.policy.hidden_states(questions.state, questions.words)
        return Gaussian.of(hidden, self.policy.backbone.mask(questions.words))

    def _update_sparsity(self) -> float | None:
        """Return the share of the pretrained weights that hardly changed, None if there are others now.

        ConSFT (arXiv 2605.08879), Eq. 8: relative change below 1e-3.
        """
        now = dict(self.policy.named_parameters())
        if now.keys() != self.weights.keys():
            return None
        unchanged = [
            (now[name] - before).abs() / (before.abs() + 1e-8) < SPARSITY_THRESHOLD
            for name, before in self.weights.items()
        ]
        return sum(int(part.sum()) for part in unchanged) / sum(part.numel() for part in unchanged)

    def _new_record(self) -> Record:
        parameters = sum(parameter.numel() for parameter in self.policy.parameters())
        return Record(
            status="success",
            run=_describe_run(self.spec, self.scenario, self.method),
            scenario=_describe_scenario(self.scenario),
            costs={"optimiser_steps": 0, "parameters": parameters},
            fingerprint={**fingerprint(self.scenario), "pretrained": _hash_of_policy(self.pretrained)},
            timing={"stages": []},
        )

    def _count_seconds(self) -> None:
        seconds = self.seconds_before + time.perf_counter() - self.begin
        self.record.timing["seconds"] = round(seconds, 2)

    def _count_costs(self) -> None:
        state = self.method.state()
        tensors = [value for value in state.values() if isinstance(value, torch.Tensor)]
        parameters = sum(parameter.numel() for parameter in self.policy.parameters())
        self.record.costs["parameters_added"] = parameters - self.record.costs["parameters"]
        kept = self._prior(len(self.scenario.target), ("throughout",)).bytes
        self.record.costs["bytes_kept"] = kept + sum(tensor.nbytes for tensor in tensors)

    # ---- checkpoints -------------------------------------------------------------------------------

    def _inputs(self, number: int) -> dict[str, Any]:
        """Return all that the state after stage `number` depends on."""
        method = package_of(type(self.method).__module__)
        return {
            "run": self.record.run,
            "scenario": self.record.scenario,
            "stage": number,
            **self._sources(method),
        }

    def _sources(self, *modules: str) -> dict[str, Any]:
        """Return the code and data that any result of a run depends on, `modules` besides."""
        suites = {package_of(name) for task in self.scenario.tasks for name in (task.world, task.expert)}
        return {
            "pretraining": pretraining_inputs(self.scenario, self.spec.seed),
            "tasks": [dataclasses.asdict(task) for task in self.scenario.tasks],
            "source": source_hash("clbench", *modules, *sorted(suites)),
        }

    def _save(self, number: int) -> None:
        """Write a checkpoint after stage `number`; earlier ones go."""

        def write(folder: Path) -> None:
            save_policy(self.policy, folder)
            state = self.method.state()
            tensors = {name: value for name, value in state.items() if isinstance(value, torch.Tensor)}
            copies = {name: value.detach().clone().contiguous() for name, value in tensors.items()}
            save_file(copies, folder / "method.safetensors")
            values = {name: value for name, value in state.items() if name not in tensors}
            (folder / "method.json").write_text(json.dumps(values), encoding="utf-8")
            write_record(self.record, folder / "record.json")

        self.where = f"state() after stage {number}"
        self._count_seconds()
        cached(self.checkpoints / f"stage-{number}", self._inputs(number), write)
        shutil.rmtree(self.checkpoints / f"stage-{number - 1}", ignore_errors=True)

    def _load(self, number: int) -> None:
        """Take the policy and the method as they were after stage `number`."""
        self.where = f"load_state() after stage {number}"
        folder = self.checkpoints / f"stage-{number}"
        state: State = {**json.loads((folder / "method.json").read_text(encoding="utf-8"))}
        state.update(load_file(folder / "method.safetensors", device=self.spec.device))
        self.method = build_method(self.spec.method, self.spec.changes)
        policy = load_policy(folder, lambda policy: self.method.load_state(policy, state))
        self.policy = policy.to(self.spec.device)

    def _resume(self) -> int | None:
        """Take the record of the latest checkpoint and return its stage, or None if there is none."""
        for number in range(len(self.scenario.target), -1, -1):
            folder = self.checkpoints / f"stage-{number}"
            if is_cached(folder, self._inputs(number)):
                started = self.record.timing["started"]
                self.record = read_record(folder / "record.json")
                self.seconds_before = self.record.timing["seconds"]
                self.record.timing.update({"started": started, "resumed_after": number})
                length = run_length(self.scenario, self.spec.split)
                self.progress(number * length / len(self.scenario.target))
                return number
        return None


def _checked(diagnostics: Any) -> dict[str, Any]:
    """Return a method's diagnostics, if a record can hold them."""
    if not isinstance(diagnostics, dict):
        raise TypeError(f"diagnostics() must return a dictionary, not {type(diagnostics).__name__}.")
    json.dumps(diagnostics, allow_nan=False)
    return diagnostics


def _episode_row(number: int, step: int, episode: Episode) -> tuple[Any, ...]:
    total_reward = round(episode.total_reward, 4) if abs(episode.total_reward) < float("inf") else None
    return (
        number,
        step,
        episode.task,
        episode.split,
        episode.number,
        int(episode.success),
        total_reward,
        episode.length,
    )


def _append(columns: dict[str, list[Any]], row: tuple[Any, ...]) -> None:
    for column, value in zip(columns.values(), row, strict=True):
        column.append(value)


def _hash_of_policy(folder: Path) -> str:
    manifest = json.loads((folder / "clbench.json").read_text(encoding="utf-8"))
    return str(manifest["files"]["policy.safetensors"][:16])
