"""Algorithms, and the pieces that they are made of. An algorithm's file is imported when it is first asked for."""

from rewax.agents.base import Agent
from rewax.agents.registry import Algorithm, algorithm, list_algorithms, make_agent, register_algorithm

__all__ = ["Agent", "Algorithm", "algorithm", "list_algorithms", "make_agent", "register_algorithm"]
