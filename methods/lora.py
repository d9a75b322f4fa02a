"""LoRA: only low-rank additions to the linear layers are trained (arXiv 2106.09685), using the library peft.

Details:
1. Every linear map inside the layers of the backbone and of the action head has an adapter: queries, keys and
   values, outputs and feed-forward. Keys and values come from one map, so they share its adapter and its
   rank. Rank 16 and alpha 32 come from AEGIS's baseline (arXiv 2604.16067), which adapts the layers of the
   language model. Here the layers of the action head are adapted as well, and everything outside the layers
   (embedding, time, position, output) stays as it is.
2. One adapter is trained on all targets in turn, as in arXiv 2603.11653; the weights that it adapts never
   change.
3. `variant` is "lora", "dora" (arXiv 2402.09353) or "rslora" (arXiv 2312.03732).
4. Adapters start from zero and must move further than full weights. `speed` therefore multiplies the learning
   rate: at a step factor of 1, it is three times that of the other methods. `speed` was chosen on validation
   episodes of the first Fetch board (docs/history.md). Where methods are tuned, `clbench tune` chose the
   learning rate and the rank.
5. `alpha` stays 32 when the rank is tuned, so that rank 4 has four times the scale of rank 16: the two are
   tuned together.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from torch import nn

from clbench.base.errors import InputError
from clbench.learning.method import Metadata, Method, MethodState, Progress, Stage
from clbench.learning.prior import Prior
from clbench.policy.policy import Policy

from ._requirements import in_range, one_of

PAST_ADAPTERS = (nn.MultiheadAttention, nn.TransformerEncoderLayer)
"""PyTorch modules whose fast paths pass the weights of their linear maps to one fused function."""
VARIANTS = ("lora", "dora", "rslora")


@dataclass
class LoRA(Method):
    """Train low-rank adapters on a frozen policy."""

    rank: int = 16
    """Rank r of each adapter."""
    alpha: float = 32.0
    """Scale: an adapter's output is multiplied by alpha / rank (by alpha / sqrt(rank) with rslora)."""
    variant: str = "lora"
    """lora, dora or rslora."""
    speed: float = 3.0
    """Factor of the learning rate."""

    metadata = Metadata(link="https://arxiv.org/abs/2106.09685")
    tunes = ("rank", (4, 64))

    def __post_init__(self) -> None:
        in_range("rank", self.rank, 1)
        in_range("alpha", self.alpha, 1e-9)
        in_range("speed", self.speed, 1e-9)
        one_of("variant", self.variant, VARIANTS)

    def prepare(self, policy: Policy, prior: Prior) -> None:
        """Add the adapters."""
        self._add(policy)

    def _add(self, policy: Policy) -> None:
        from peft import LoraConfig, inject_adapter_in_model  # takes seconds to import

        linear = [
            name
            for name, module in policy.named_modules()
            if isinstance(module, nn.Linear) and "layers" in name.split(".")
        ]
        for name in linear:
            owner = policy.get_submodule(name.rpartition(".")[0])
            if isinstance(owner, PAST_ADAPTERS):
                raise InputError(
                    f"lora would change nothing in {name}: {type(owner).__name__} reads its weights past the "
                    "adapters. Write attention with nn.Linear maps, or leave lora out."
                )
        if not linear:
            raise InputError(
                f"lora needs linear maps inside modules that are called `layers`; {type(policy).__name__} "
                "has none. Rename one, or leave lora out."
            )
        config = LoraConfig(
            r=self.rank,
            lora_alpha=self.alpha,  # type: ignore[arg-type]
            target_modules=linear,
            use_dora=self.variant == "dora",
            use_rslora=self.variant == "rslora",
        )
        inject_adapter_in_model(config, policy)

    def start_task(self, policy: Policy, stage: Stage) -> Iterable[nn.Parameter]:
        """Return the adapters' weights."""
        return [parameter for name, parameter in policy.named_parameters() if "lora_" in name]

    def learning_rate(self, scheduled: float, progress: Progress) -> float:
        """Return the adapters' learning rate."""
        return self.speed * scheduled

    def state(self) -> MethodState:
        """Return a mark that the adapters exist; their weights belong to the policy."""
        return {"adapted": True}

    def load_state(self, policy: Policy, state: MethodState) -> None:
        """Add the adapters to a plain policy; the checkpoint holds their weights."""
        self._add(policy)
