"""The error of the contract: it says what was expected, what was found, and where to look."""

from __future__ import annotations

PAGE = "docs/guide/contract.md"
"""The contract in words, a heading for each clause."""


class ContractError(AssertionError):
    """A method breaks the public contract.

    Args:
        clause: What it breaks, as "same numbers": a heading of `docs/guide/contract.md`.
        expected: What would have been right.
        found: What there is instead.
        look: Where in the method's class to look, as "loss()".
    """

    def __init__(self, clause: str, expected: str, found: str, look: str) -> None:
        super().__init__(clause, expected, found, look)
        self.clause, self.expected, self.found, self.look = clause, expected, found, look

    def __str__(self) -> str:
        return (
            f"The method breaks the contract: {self.clause}.\n"
            f"  expected: {self.expected}\n"
            f"  found:    {self.found}\n"
            f"  look at:  {self.look}; {PAGE}#{self.clause.replace(' ', '-')}"
        )
