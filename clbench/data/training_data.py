"""Training data of a run: questions, and demonstrations that are read on first use."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from clbench.data.demonstrations import Demonstrations, load_demonstrations
from clbench.data.questions import Questions, load_questions, scored_questions
from clbench.policy.batch import QuestionBatch
from clbench.policy.policy import PolicyConfig
from clbench.spec.protocol import ScoredSplit
from clbench.spec.scenario import Scenario
from clbench.spec.task import Task


@dataclass
class TrainingData:
    """Demonstrations and questions of a scenario, in the chunks that fit a policy."""

    scenario: Scenario
    """Scenario, whose budget gives the number of demonstrations of a task."""
    config: PolicyConfig
    """Sizes of the policy."""
    questions: Questions
    """Training questions."""
    test_questions: Questions
    """Test questions; no method gets them."""
    _loaded: dict[str, Demonstrations] = field(default_factory=dict, init=False, repr=False)

    @classmethod
    def open(cls, scenario: Scenario, config: PolicyConfig) -> TrainingData:
        """Return the data of a scenario; its questions are collected on first use.

        Args:
            scenario: Scenario with its tasks and questions.
            config: Sizes of the policy.
        """
        questions, test_questions = load_questions(scenario)
        return cls(scenario, config, questions, test_questions)

    def scored_questions(self, split: ScoredSplit) -> tuple[Tensor, QuestionBatch]:
        """Return the kinds and the questions that score a run on a split.

        A tuning run, which is scored on validation episodes, must not see the test questions.
        """
        questions = self.questions if split == "validation" else self.test_questions
        return scored_questions(questions, self.scenario.budget.test_questions)

    def demonstrations(self, task: Task) -> Demonstrations:
        """Return the demonstrations of a task, which are read on first use.

        Most methods never see the demonstrations of the retained skills.
        """
        if task.name not in self._loaded:
            self._loaded[task.name] = load_demonstrations(task, self.scenario, self.config)
        return self._loaded[task.name]
