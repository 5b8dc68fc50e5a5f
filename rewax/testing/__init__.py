"""Checks that users can run on their own environments, agents, laws, shapes and contact pairs."""

from rewax.testing.agent import check_agent
from rewax.testing.contact_pair import check_contact_pair
from rewax.testing.env import check_env
from rewax.testing.law import check_law
from rewax.testing.lowered import where_it_runs
from rewax.testing.shape import check_shape

__all__ = ["check_agent", "check_contact_pair", "check_env", "check_law", "check_shape", "where_it_runs"]
