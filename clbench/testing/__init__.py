"""For tests, ours and other people's: a toy on which a whole run takes seconds, and what all must keep.

Import this package to register the toy as `clbench/Toy-v0`, or ask for "clbench.testing:clbench/Toy-v0".
"""

from typing import TYPE_CHECKING

from clbench.lazy import lazy_names
from clbench.registration import register

if TYPE_CHECKING:
    from clbench.testing.contract import Check as Check
    from clbench.testing.contract import check_method as check_method
    from clbench.testing.contract import method_checks as method_checks
    from clbench.testing.error import ContractError as ContractError
    from clbench.testing.scenario import ScenarioError as ScenarioError
    from clbench.testing.scenario import check_scenario as check_scenario
    from clbench.testing.toy import TOY as TOY
    from clbench.testing.toy import TOY_QUESTIONS as TOY_QUESTIONS
    from clbench.testing.toy import ToyWorld as ToyWorld
    from clbench.testing.toy import toy_expert as toy_expert

_HOMES = {
    "contract": ("Check", "check_method", "method_checks"),
    "error": ("ContractError",),
    "scenario": ("ScenarioError", "check_scenario"),
    "toy": ("TOY", "TOY_QUESTIONS", "ToyWorld", "toy_expert"),
}
"""In which module each name lives. It is imported when first used: a process that draws needs no PyTorch."""

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

__getattr__, __dir__ = lazy_names(__name__, _HOMES)

register("clbench/Toy-v0", "clbench.testing:TOY")
