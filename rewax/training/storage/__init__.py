"""What a run leaves on disk: checkpoints, configurations, metrics, exports; and caches."""
