"""Train SAPO: ``python examples/train_sapo.py --env=RollingFlat``; ``--help`` lists every hyper-parameter."""

import os
import sys

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # jax 0.10 prints an "error" for every program found in its cache

from rewax.agents.presets import sapo_preset
from rewax.agents.sapo import make_sapo
from rewax.training import cli

if __name__ == "__main__":
    sys.exit(cli.main("sapo", make_sapo, sapo_preset))
