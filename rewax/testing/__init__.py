"""Checks that users can run on their own environments."""

from rewax.testing.env import check_env

__all__ = ["check_env"]
