"""The training loop: start or resume, iterate, finish."""
