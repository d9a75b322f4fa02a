"""The error of the contract: it shows the expectation, the finding, and the place to look at."""

from __future__ import annotations

PAGE = "docs/guide/contract.md"
"""Page that describes the contract, with a heading for each clause."""


class ContractError(AssertionError):
    """A method breaks the public contract.

    Args:
        clause: Name of the clause, for example "same numbers": a heading of `docs/guide/contract.md`.
        expected: Expected behaviour.
        found: Actual behaviour.
        look: Place in the method's class to look at, for example "loss()".
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
