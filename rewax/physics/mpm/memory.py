"""How much memory a gradient through a simulation takes, before it is compiled."""

from rewax.physics.mpm import transfer_cpp
from rewax.physics.mpm.stepping import MPMScene

_PARTICLE_FLOATS = 24
"""Position, velocity, affine field and deformation gradient: what is stored of a particle."""
_CONTROL_STEP_FLOATS = 27
"""What a rollout keeps of a particle at the beginning of each control step."""
_WORKSPACE_FLOATS = {True: 104, False: 498}
"""Per particle, while one substep is differentiated, with transfers in C++ and in JAX. JAX stores the 27 nodes' values
of 4 fields, three times; C++ stores none of them."""
_NODE_FLOATS = 11
_COLLIDER_FLOATS = {True: 34, False: 42}
"""Per active node and collider, while contact is differentiated."""


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
    """Peak bytes of the gradient of a rollout whose control steps are checkpointed.

    Particles are stored at the beginning of each of ``horizon`` control steps and, within the one that is being
    differentiated, every ``store_every`` substeps; everything else is recomputed. So memory grows with particles
    times (horizon + substeps) and, through the workspace of one substep, with active nodes; the box itself does not
    count unless ``scene.max_active_nodes`` is None. Networks and the rest of a program come on top.

    Args:
      scene: grid, active nodes and colliders count.
      num_particles: of one environment.
      num_substeps: of one control step.
      num_envs: environments side by side.
      horizon: control steps that are differentiated through.
      store_every: as for ``mpm.step``.
      bytes_per_float: 4, or 8 in float64.

    The constants are fitted to what XLA allocates on CPUs, with transfers in C++ or in JAX, whichever this process uses
    (jax 0.10; tests hold it to 15 %).

    Example:
      >>> predict_peak_bytes(env.scene, num_particles=2592, num_substeps=40, num_envs=32, horizon=32) / 1e9
      0.748
    """
    if store_every < 1 or num_substeps % store_every:
        raise ValueError(f"store_every is {store_every} with {num_substeps} substeps: give a number that divides them")
    stored = num_substeps // store_every + (store_every if store_every > 1 else 0)
    nodes = scene.grid.num_nodes if scene.max_active_nodes is None else scene.max_active_nodes
    native = transfer_cpp.is_used()
    per_particle = _PARTICLE_FLOATS * stored + _CONTROL_STEP_FLOATS * horizon + _WORKSPACE_FLOATS[native]
    per_node = _NODE_FLOATS + _COLLIDER_FLOATS[native] * len(scene.colliders)
    return bytes_per_float * num_envs * (num_particles * per_particle + nodes * per_node)
