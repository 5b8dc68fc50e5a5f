"""``python -m rewax``: the same as the command ``rewax``."""

import sys

from rewax.cli.main import main

sys.exit(main())
