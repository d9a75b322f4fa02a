"""SFT: plain supervised fine-tuning, every parameter on the target's demonstrations alone.

The baseline that every other method is compared with: it learns the target and protects nothing.
"""

from dataclasses import dataclass

from clbench.learning.method import Method


@dataclass
class SFT(Method):
    """Descend the target's action loss with all parameters."""
