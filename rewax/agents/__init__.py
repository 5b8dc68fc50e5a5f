"""Algorithms, and the parts that they share. An algorithm's module is imported on first use."""

from rewax.agents.base import Agent
from rewax.agents.registry import Algorithm, algorithm, list_algorithms, make_agent, register_algorithm

__all__ = ["Agent", "Algorithm", "algorithm", "list_algorithms", "make_agent", "register_algorithm"]
