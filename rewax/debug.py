"""Locates the first non-finite value of a simulation."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics import mpm
from rewax.physics.mpm import MPMScene, MPMState
from rewax.physics.numerics import Pose
from rewax.physics.numerics.arguments import check_instance
from rewax.physics.numerics.checks import static_integer

FIELDS = ("x", "v", "C", "F", "memory")


class NaNLocation(NamedTuple):
    """The first non-finite value."""

    substep: int
    """Index of the substep that produced it; -1: the start held it."""
    field: str
    """Field of ``MPMState``: the first of x, v, C, F, memory that holds one."""
    particle: int
    """Index of the first particle that has one."""
    before: dict[str, np.ndarray]
    """The particle's values by field, before that substep or at the start."""

    def __str__(self) -> str:
        when = "at the start" if self.substep < 0 else f"in substep {self.substep}"
        values = "; ".join(
            f"{name} {np.array2string(a, precision=4).replace(chr(10), '')}" for name, a in self.before.items()
        )
        return f"{self.field} of particle {self.particle} is not finite {when}; before: {values}"


def locate_nan(scene: MPMScene, state: MPMState, poses: Pose, *, list_every: int | None = None) -> NaNLocation | None:
    """The first substep, field and particle with a non-finite value, or None.

    Repeats ``mpm.step``, or a control step of a task, substep by substep. It cannot run inside ``jit``.

    Args:
      scene: the scene.
      state: particles of one environment at the start of the step.
      poses: poses of the scene's bodies at the boundaries of substeps, as for ``mpm.step``.
      list_every: the substeps for which one list of active nodes serves, as a task's ``list_every``; None: all.

    Example:
      >>> if int(state.status) & Status.NAN:
      ...     print(locate_nan(env.scene, previous.physics.soft, poses, list_every=env.list_every))

    Raises:
      ValueError: ``list_every`` is not a positive integer, or another argument is of another type.
    """
    check_instance("scene", scene, MPMScene, "give that of the environment, env.scene for example")
    check_instance("state", state, MPMState, "give particles, state.physics.soft for example")
    check_instance("poses", poses, Pose, "give poses of the scene's bodies, mpm.static_poses(20) for example")
    substeps = poses.position.shape[0] - 1
    every = static_integer("list_every", max(1, substeps) if list_every is None else list_every, 1, "give 1 or more")
    first = _first_bad(state)
    if first is not None:
        return NaNLocation(-1, *first, _particle(state, first[1]))
    nodes, nodes_near = None, jax.jit(mpm.nodes_of_step)
    one = jax.jit(lambda state, nodes, before, after: mpm.substep(scene, state, before, after, nodes=nodes))
    for substep in range(substeps):
        nodes = nodes_near(scene, state.x) if substep % every == 0 else nodes
        before, after = (jax.tree.map(lambda p, i=i: p[i], poses) for i in (substep, substep + 1))
        new = one(state, nodes, before, after)
        first = _first_bad(new)
        if first is not None:
            return NaNLocation(substep, *first, _particle(state, first[1]))
        state = new
    return None


def _first_bad(state: MPMState) -> tuple[str, int] | None:
    for name in FIELDS:
        value = getattr(state, name)
        if value is None:
            continue
        finite = np.asarray(jnp.isfinite(value)).reshape(len(value), -1).all(axis=-1)
        if not finite.all():
            return name, int(np.argmin(finite))
    return None


def _particle(state: MPMState, index: int) -> dict[str, np.ndarray]:
    values = {name: getattr(state, name) for name in FIELDS}
    return {name: np.asarray(value[index]) for name, value in values.items() if value is not None}
