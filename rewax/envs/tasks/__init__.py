"""Tasks, one a file. ``rewax.make`` makes them; a task's file is imported when it is first made."""
