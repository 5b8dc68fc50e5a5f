"""The command line, ``rewax COMMAND``: one module per command, imported when the command runs."""
