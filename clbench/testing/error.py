"""The error of the contract: it shows the expectation, the finding, and the place to look at."""

from __future__ import annotations

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
