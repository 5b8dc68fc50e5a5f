"""Checks that users can run on their own environments and laws."""

from rewax.testing.env import check_env
from rewax.testing.law import check_law
from rewax.testing.lowered import where_it_runs

__all__ = ["check_env", "check_law", "where_it_runs"]
