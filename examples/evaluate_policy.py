"""``python examples/evaluate_policy.py --run-dir runs/RollingFlat-small-0``, the same as ``rewax eval``."""

import sys

from rewax.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["eval", *sys.argv[1:]]))
