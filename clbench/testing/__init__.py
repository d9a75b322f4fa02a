"""For tests, ours and other people's: a toy on which a whole run takes seconds, and what all must keep.

Import this package to register the toy as `clbench/Toy-v0`, or ask for "clbench.testing:clbench/Toy-v0".
"""

from clbench.testing.contract import Check, check_method, method_checks
from clbench.testing.error import ContractError
from clbench.testing.scenario import ScenarioError, check_scenario
from clbench.testing.toy import TOY, TOY_QUESTIONS, ToyWorld, toy_expert

__all__ = [
    "TOY",
    "TOY_QUESTIONS",
    "Check",
    "ContractError",
    "ScenarioError",
    "ToyWorld",
    "check_method",
    "check_scenario",
    "method_checks",
    "toy_expert",
]
