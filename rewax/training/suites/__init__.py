"""Suites of runs: which tasks, algorithms and seeds, their runs and tables."""
