"""Checks that users can run on their own environments."""

from rewax.testing.env import check_env
from rewax.testing.lowered import where_it_runs

__all__ = ["check_env", "where_it_runs"]
