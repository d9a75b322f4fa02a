"""SFT: plain supervised fine-tuning of all parameters, on the target's demonstrations alone.

The baseline for every other method: it learns the target and protects nothing.
"""

from dataclasses import dataclass

from clbench.learning.method import Method


@dataclass
class SFT(Method):
    """Minimise the target's action loss over all parameters."""
