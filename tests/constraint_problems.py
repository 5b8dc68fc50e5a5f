"""Random problems of constraint forces, and the cost that their solution minimises."""

import numpy as np

from rewax.physics.rigid.line_search import Rows

KINDS = {
    "equality": (-np.inf, np.inf),
    "friction": (-1.0, 1.0),
    "contact": (0.0, np.inf),
}
SIX = ["equality", "friction", "friction", "friction", "contact", "contact", "contact"]


def spd(rng, n: int, condition: float = 1e3) -> np.ndarray:
    q = np.linalg.qr(rng.standard_normal((n, n)))[0]
    return (q * np.geomspace(1.0, condition, n)) @ q.T


def problem(seed: int, n: int, kinds: list[str], spread: float = 3.0):
    """A random mass matrix, force and rows; rows with a finite upper bound first."""
    rng = np.random.default_rng(seed)
    bounds = np.array([KINDS[k] for k in kinds]) * rng.uniform(0.3, 3.0, (len(kinds), 1))
    rows = Rows(
        jacobian=rng.standard_normal((len(kinds), n)),
        stiffness=10.0 ** rng.uniform(-1, spread, len(kinds)),
        target=rng.standard_normal(len(kinds)),
        lower=np.nan_to_num(bounds[:, 0], nan=0.0, neginf=-np.inf),
        upper=bounds[:, 1],
    )
    return spd(rng, n, 30.0), 3.0 * rng.standard_normal(n), rows, 3.0 * rng.standard_normal(n)


def cost(mass, force, rows, a):
    """What the accelerations minimise: quadratic near the target, linear beyond the bounds of the force."""
    missed = rows.jacobian @ a - rows.target
    f = np.clip(-rows.stiffness * missed, rows.lower, rows.upper)
    return 0.5 * a @ mass @ a - force @ a - np.sum(f * missed + 0.5 * f * f / rows.stiffness)
