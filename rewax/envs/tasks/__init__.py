"""One file for each task. ``rewax.make`` builds a task and imports its file when it is first made."""
