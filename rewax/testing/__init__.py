"""Checks that users can run on their own environments and contact pairs."""

from rewax.testing.contact_pair import check_contact_pair
from rewax.testing.env import check_env
from rewax.testing.lowered import where_it_runs

__all__ = ["check_contact_pair", "check_env", "where_it_runs"]
