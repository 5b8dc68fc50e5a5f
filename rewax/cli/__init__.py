"""The command line, ``rewax train | eval | bench | landscape | envs``. A command imports what it needs when it runs."""
