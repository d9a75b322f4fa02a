"""Metrics of your own success matrices: `from_matrix` takes arrays, `from_csv` takes a file."""

from clbench.metrics.matrices import from_matrix
from clbench.metrics.report import Flip, Report, Value
from clbench.metrics.tables import from_csv

__all__ = ["Flip", "Report", "Value", "from_csv", "from_matrix"]
