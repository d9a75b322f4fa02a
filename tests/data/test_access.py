"""Leaks: a method that uses data its stage must not know is caught, and the error names the data."""

from pathlib import Path

import pytest

from clbench.learning.registry import load_method
from clbench.runs.run import execute
from clbench.runs.spec import RunSpec
from clbench.testing import ContractError, check_method

TOY = "clbench.testing:clbench/Toy-v0"

METHODS = '''
import dataclasses

from clbench.base.entry_points import resolve
from clbench.data.demonstrations import dataset_folder, demonstrate, load_demonstrations, read_dataset
from clbench.evaluation.episodes import Trial
from clbench.evaluation.players import play
from clbench.evaluation.rollouts import Evaluator
from clbench.learning.method import Method
from clbench.learning.prior import Uses
from clbench.data.questions import load_questions
from clbench.testing import TOY


@dataclasses.dataclass
class Ahead(Method):
    """It looks at the demonstrations of the next target."""

    def start_task(self, policy, stage):
        following = TOY.target[stage.number % len(TOY.target)]
        load_demonstrations(following, TOY, policy.config)
        return policy.parameters()


@dataclasses.dataclass
class Undeclared(Method):
    """It reads the demonstrations of a skill, which `uses` does not declare."""

    def start_task(self, policy, stage):
        load_demonstrations(TOY.retained[0], TOY, policy.config)
        return policy.parameters()


@dataclasses.dataclass
class Direct(Method):
    """It reads the folder of a later target's dataset."""

    def start_task(self, policy, stage):
        read_dataset(dataset_folder(TOY.target[-1], TOY.budget))
        return policy.parameters()


@dataclasses.dataclass
class Declared(Undeclared):
    """The same, declared; it also reads its own target."""

    uses = Uses(demonstrations="throughout")

    def start_task(self, policy, stage):
        load_demonstrations(stage.task, TOY, policy.config)
        return super().start_task(policy, stage)


@dataclasses.dataclass
class Chooser(Method):
    """It chooses its checkpoint on test episodes."""

    split = "test"
    task = 0

    def end_task(self, policy, stage):
        evaluator = Evaluator(TOY, 0)
        try:
            evaluator.play(policy, [Trial(TOY.target[self.task], self.split, 0)])
        finally:
            evaluator.close()


@dataclasses.dataclass
class RobustChooser(Chooser):
    """It chooses its checkpoint on perturbed episodes, which repeat the test episodes."""

    split = "perturbed"


@dataclasses.dataclass
class EarlyChooser(Chooser):
    """It tunes on validation episodes of a target that comes later."""

    split = "validation"
    task = 1


@dataclasses.dataclass
class Rehearser(Method):
    """It plays what it can already do, to replay it, and declares no prior data."""

    def end_task(self, policy, stage):
        evaluator = Evaluator(TOY, 7)
        try:
            evaluator.play(policy, [Trial(TOY.retained[0], "validation", 1000)])
        finally:
            evaluator.close()


@dataclasses.dataclass
class Pupil(Method):
    """It asks the expert of a skill for an episode, and declares no prior data."""

    def start_task(self, policy, stage):
        demonstrate(resolve(TOY.retained[0].world)(), TOY.retained[0], 0, noisy=False)
        return super().start_task(policy, stage)


@dataclasses.dataclass
class FairChooser(Chooser):
    """It looks at validation episodes of what it has learned, as it may."""

    split = "validation"


@dataclasses.dataclass
class Player(Method):
    """It chooses on test episodes that a function for agents plays."""

    def end_task(self, policy, stage):
        play(lambda observation: TOY.target[0], TOY, [Trial(TOY.target[0], "test", 0)], 0, "text", False)


@dataclasses.dataclass
class Late(Method):
    """It reads the questions of the report in the hook after a stage that `hook` names."""

    hook: str = "state"

    def _look(self, hook):
        if hook == self.hook:
            load_questions(TOY)

    def diagnostics(self):
        self._look("diagnostics")
        return {}

    def state(self):
        self._look("state")
        return {}

    def load_state(self, policy, state):
        self._look("load_state")


@dataclasses.dataclass
class Asker(Method):
    """It reads the questions of the report."""

    def prepare(self, policy, prior):
        load_questions(TOY)


@dataclasses.dataclass
class Normaliser(Method):
    """It takes the normalisation from the target."""

    def start_task(self, policy, stage):
        batch = stage.target.sample(64)
        policy.normalise_like(batch.state, batch.action[:, 0])
        return policy.parameters()


@dataclasses.dataclass
class Talker(Method):
    """It makes room for the words of later tasks."""

    def prepare(self, policy, prior):
        policy.config = dataclasses.replace(policy.config, vocabulary_size=policy.config.vocabulary_size + 9)
'''


@pytest.fixture(autouse=True)
def _methods(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "leaky.py").write_text(METHODS, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "message"),
    [
        ("Ahead", "reads demonstrations of down, which its stage must not know yet"),
        ("Direct", "reads demonstrations of down, which its stage must not know yet"),
        ("Undeclared", "reads demonstrations of left, which its `uses` does not declare"),
        ("Chooser", "runs test episodes of right: no choice may depend on them"),
        ("RobustChooser", "runs perturbed episodes of right: no choice may depend on them"),
        ("EarlyChooser", "runs episodes of down, which its stage must not know yet"),
        ("Rehearser", "runs episodes of left, which its `uses` does not declare"),
        ("Pupil", "reads demonstrations of left, which its `uses` does not declare"),
        ("Player", "runs test episodes of right: no choice may depend on them"),
        ("Asker", "loads the questions itself, the test questions too"),
        ("Normaliser", "changes state_mean: the normalisation is fixed in pretraining"),
        ("Talker", "changes the vocabulary or a size of the policy"),
    ],
)
def test_a_planted_leak_ends_the_run_and_is_named(method: str, message: str, tmp_path: Path) -> None:
    record = execute(RunSpec(TOY, f"leaky:{method}", 0), tmp_path)
    assert record.status == "failed"
    assert record.error is not None
    assert record.error["type"] == "LeakError"
    assert message in record.error["message"]


@pytest.mark.parametrize("hook", ["diagnostics", "state"])
def test_a_hook_after_a_stage_may_read_no_more_than_those_in_it(hook: str, tmp_path: Path) -> None:
    record = execute(RunSpec(TOY, "leaky:Late", 0, {"hook": hook}), tmp_path)
    assert record.error is not None
    assert record.error["where"] == f"{hook}() after stage 0"
    assert "loads the questions itself" in record.error["message"]


def test_a_hook_that_restores_a_state_may_read_no_more() -> None:
    with pytest.raises(ContractError, match="loads the questions itself"):
        check_method(load_method("leaky:Late"), hook="load_state")


@pytest.mark.long
@pytest.mark.parametrize("method", ["FairChooser", "Declared"])
def test_a_stage_may_use_everything_that_it_may_know(method: str, tmp_path: Path) -> None:
    assert execute(RunSpec(TOY, f"leaky:{method}", 0, targets=1), tmp_path).status == "success"
