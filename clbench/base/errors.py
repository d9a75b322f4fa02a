"""Errors that clbench explains.

The command line shows the message of a `ClbenchError` in one line. Any other exception is a bug, and shows
its traceback. Each class also derives from the built-in exception that a caller would expect.
"""

from __future__ import annotations


class ClbenchError(Exception):
    """An error with a complete message for the user: the fault, and the expected value."""


class InputError(ClbenchError, ValueError):
    """A value is out of range, has the wrong form, or contradicts another value."""


class UnknownNameError(ClbenchError, LookupError):
    """Nothing has this name; the message names the nearest one."""


class NoRecordsError(ClbenchError, FileNotFoundError):
    """There is no folder of records; the message says how to get one."""


class MissingPackageError(ClbenchError, LookupError):
    """A package is not installed; the message says how to get it."""


class WrongTypeError(ClbenchError, TypeError):
    """An object does not have the expected type."""
