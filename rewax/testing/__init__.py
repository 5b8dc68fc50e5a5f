"""Checks that users can run on their own environments and shapes."""

from rewax.testing.env import check_env
from rewax.testing.lowered import where_it_runs
from rewax.testing.shape import check_shape

__all__ = ["check_env", "check_shape", "where_it_runs"]
