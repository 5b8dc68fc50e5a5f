"""Suites of ``rewax bench``: TOML files, read by ``rewax.training.suites.suite``."""
