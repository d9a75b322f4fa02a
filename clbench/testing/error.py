"""What both contracts share: the check of a clause, and the error that names the place to look at."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

PAGE = "docs/guide/contract.md"
"""Page that describes the contract of a method, with a heading for each clause."""


class ContractError(AssertionError):
    """A method, or a policy, breaks its public contract.

    Args:
        clause: Name of the clause, for example "same numbers": a heading of the page.
        expected: Expected behaviour.
        found: Actual behaviour.
        look: Place in the class to look at, for example "loss()".
        subject: What breaks it: "method" or "policy".
        page: Page that describes the contract.
    """

    def __init__(
        self, clause: str, expected: str, found: str, look: str, subject: str = "method", page: str = PAGE
    ) -> None:
        super().__init__(clause, expected, found, look, subject, page)
        self.clause, self.expected, self.found, self.look = clause, expected, found, look
        self.subject, self.page = subject, page

    def __str__(self) -> str:
        return (
            f"The {self.subject} breaks the contract: {self.clause}.\n"
            f"  expected: {self.expected}\n"
            f"  found:    {self.found}\n"
            f"  look at:  {self.look}; {self.page}#{self.clause.replace(' ', '-')}"
        )


@dataclass(frozen=True, eq=False)
class Check:
    """One clause of a contract for one subject; call it to check."""

    clause: Callable[[Any], None]
    """Clause, one of the contract's `CLAUSES`."""
    subject: Any
    """Method or policy to check."""

    def __call__(self) -> None:
        """Check the clause.

        Raises:
            ContractError: The subject breaks the clause.
        """
        self.clause(self.subject)

    def __str__(self) -> str:
        return self.clause.__name__
