"""The worked example of `docs/guide/your_method.md`, run unchanged, as a stranger would."""

import importlib
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from clbench.learning.method import Progress, Stage
from clbench.learning.prior import Nothing, Prior, Source
from clbench.policy.policy import Policy
from clbench.testing import TOY
from clbench.testing.small import SMALL, toy_source

PAGE = Path(__file__).parents[1] / "docs" / "guide" / "your_method.md"

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the Python of the page; its first block can be imported as `der`."""
    found = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    (tmp_path / "der.py").write_text(found[0], encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "der", raising=False)
    return found


@pytest.fixture
def der(blocks: list[str]) -> Any:
    """Return the method of the page."""
    return importlib.import_module("der").DER(kept=8)


def test_its_method_keeps_the_contract(blocks: list[str]) -> None:
    exec(blocks[1], {})


def test_its_loss_is_that_of_der_plus_plus(der: Any) -> None:
    policy, later = Policy(SMALL), Policy(SMALL, seed=1)
    der.prepare(policy, Prior({"demonstrations": toy_source("left", "up")}))
    new, (old, velocity), replayed = der.batch(toy_source("right"), Prior({}))
    torch.manual_seed(3)
    loss = der.loss(later, (new, (old, velocity), replayed), Progress(0, 10)).item()
    torch.manual_seed(3)
    fresh = vars(replayed) | {
        "draw": torch.rand_like(replayed.draw),
        "noise": torch.randn_like(replayed.noise),
    }
    with torch.no_grad():
        now, then = (one.predict(old).numpy() for one in (later, policy))
        plain = [later.action_loss(batch).numpy().mean() for batch in (new, type(new)(**fresh))]
    errors = ((now - then) ** 2)[old.valid.numpy() > 0]
    assert loss == pytest.approx(plain[0] + 1.0 * errors.mean() + 0.5 * plain[1], rel=1e-5)
    assert np.all(errors > 0)


def test_its_method_begins_without_skills_and_remembers_from_the_first_target_on(der: Any) -> None:
    nothing: Any = Nothing()
    policy, generator = Policy(SMALL), torch.Generator()
    der.prepare(policy, Prior({"demonstrations": Source(nothing, generator, 8)}))
    assert der.state() == {}
    der.load_state(policy, {})
    source = toy_source("right")
    new, *rest = der.batch(source, Prior({}))
    assert rest == [None, None]
    loss = der.loss(policy, (new, None, None), Progress(0, 10))
    assert loss.item() == policy.action_loss(new).mean().item()
    der.end_task(policy, Stage(1, TOY.task("right"), 0, 10, source, Prior({})))
    assert len(der.memory) == len(der.velocity) == 8
