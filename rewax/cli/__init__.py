"""The command line: ``rewax train | eval | envs``. What a command needs is imported when it runs."""
