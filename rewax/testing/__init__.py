"""Checks that users can run on their own environments, agents, laws, shapes and contact pairs."""

from typing import TYPE_CHECKING

from rewax.lazy import lazy_names
from rewax.testing.contact_pair import check_contact_pair
from rewax.testing.env import check_env
from rewax.testing.law import check_law
from rewax.testing.lowered import where_it_runs
from rewax.testing.shape import check_shape

if TYPE_CHECKING:
    from rewax.testing.agent import check_agent as check_agent

# Imported on first use: only this check imports agents, and the libraries of their networks.
__getattr__, __dir__ = lazy_names(__name__, {"check_agent": "rewax.testing.agent"})

__all__ = ["check_agent", "check_contact_pair", "check_env", "check_law", "check_shape", "where_it_runs"]
