"""Train SAPO: ``python examples/train_sapo.py --env=RollingFlat``, the same as ``rewax train --env=RollingFlat``."""

import sys

from rewax.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["train", "--algo=sapo", *sys.argv[1:]]))
