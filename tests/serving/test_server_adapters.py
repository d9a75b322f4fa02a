"""What the adapters of a server say about policies that return something other than they should."""

from typing import Any

import numpy as np
import pytest

from clbench.serving.server import openpi_policy

OBSERVATIONS = {
    "state": np.zeros((1, 3), np.float32),
    "instruction": np.array(["go left"]),
    "seed": np.zeros(1, np.int64),
    "step": np.zeros(1, np.int64),
}


@pytest.mark.parametrize(
    ("returned", "what"),
    [(np.zeros((4, 2)), "ndarray"), ({"action": 0, "timing": 1}, "one with action, timing")],
)
def test_a_policy_that_returns_no_actions_by_name_is_told_what_it_returned(returned: Any, what: str) -> None:
    class Policy:
        """Returns what the test gives it."""

        def infer(self, obs: dict[str, Any]) -> Any:
            return returned

    with pytest.raises(TypeError, match=rf"a dictionary with `actions`, \(H, A\), not {what}\."):
        openpi_policy(Policy())(OBSERVATIONS)
