"""Files of runs: checkpoints, configurations, metrics, exports; and caches."""
