"""Prediction of the memory that a gradient through a simulation takes, without compiling it."""

from rewax.physics.mpm import transfer_cpp
from rewax.physics.mpm.scene import SCENE, MPMScene
from rewax.physics.numerics.fields import checked, integer, one_of
from rewax.physics.numerics.substeps import check_store_every

_PARTICLE_FLOATS = 24
"""Floats stored per particle: position, velocity, affine field and deformation gradient."""
_CONTROL_STEP_FLOATS = 27
"""Floats that a rollout stores per particle at the beginning of each control step."""
_WORKSPACE_FLOATS = {True: 104, False: 498}
"""Floats per particle while one substep is differentiated, with transfers in C++ (True) and in JAX (False). JAX stores
the 27 nodes' values of 4 fields three times; C++ stores none of them."""
_NODE_FLOATS = 11
_COLLIDER_FLOATS = {True: 34, False: 42}
"""Floats per active node and collider while contact is differentiated."""


_COUNT = integer(1, "give an integer of at least 1")


@checked(
    **dict.fromkeys(("num_particles", "num_substeps", "num_envs", "horizon"), _COUNT),
    scene=SCENE,
    bytes_per_float=one_of(4, 8),
)
def predict_peak_bytes(
    scene: MPMScene,
    *,
    num_particles: int,
    num_substeps: int,
    num_envs: int = 1,
    horizon: int = 1,
    store_every: int = 1,
    bytes_per_float: int = 4,
) -> int:
    """Peak bytes of the gradient of a rollout with checkpointed control steps.

    Particles are stored at the beginning of each of ``horizon`` control steps. Within the control step that is being
    differentiated they are stored every ``store_every`` substeps. Everything else is recomputed. So memory grows with
    particles times (horizon + substeps), and with active nodes through the workspace of one substep. The size of the
    box counts only if ``scene.max_active_nodes`` is None. Networks and the rest of a program come on top.

    Args:
      scene: its grid, active nodes and colliders are used.
      num_particles: particles of one environment.
      num_substeps: substeps of one control step.
      num_envs: environments in the batch.
      horizon: differentiated control steps.
      store_every: as for ``mpm.step``, but not None.
      bytes_per_float: 4, or 8 in float64.

    The constants are fitted to XLA's allocations on CPUs, with the transfers that this process uses, C++ or JAX (jax
    0.10; tests hold the prediction to 15 %).

    Raises:
      ValueError: a count is no integer of at least 1, ``bytes_per_float`` is not 4 or 8, or ``store_every`` is None or
        does not divide ``num_substeps``.

    Example:
      >>> predict_peak_bytes(env.scene, num_particles=2592, num_substeps=40, num_envs=32, horizon=32) / 1e9
      0.748
    """
    if store_every is None:
        raise ValueError("store_every is None, and what XLA then stores is not predicted: give an integer")
    check_store_every(store_every, num_substeps)
    stored = num_substeps // store_every + (store_every if store_every > 1 else 0)
    nodes = scene.grid.num_nodes if scene.max_active_nodes is None else scene.max_active_nodes
    native = transfer_cpp.is_used()
    per_particle = _PARTICLE_FLOATS * stored + _CONTROL_STEP_FLOATS * horizon + _WORKSPACE_FLOATS[native]
    per_node = _NODE_FLOATS + _COLLIDER_FLOATS[native] * len(scene.colliders)
    return bytes_per_float * num_envs * (num_particles * per_particle + nodes * per_node)
