"""A small cloth and a rope, their scenes, and static equilibria by Newton's method, for tests of thin bodies."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics import thin

STEP = jax.jit(thin.step, static_argnames="store_every")
SHEET = thin.sheet(0.4, 0.3, 4, 3)
CLOTH = {"youngs_modulus": 1e5, "poissons_ratio": 0.3, "thickness": 5e-3, "density": 300.0}
LINE = thin.rope(np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 9))
NOTHING = (0.0, 0.0, 0.0)


def cloth_scene(mesh=SHEET, *, damping=0.0, **changes):
    cloth = thin.isotropic_cloth(**CLOTH, damping=damping)
    return thin.make_scene(**({"mesh": mesh, "dt": 2e-4, "cloth": cloth, "gravity": NOTHING} | changes))


def rope_scene(mesh=LINE, *, stretch=1e3, bending=0.1, damping=0.0, **changes):
    rope = thin.Rope(stretch=stretch, bending=bending, density=0.1, damping=damping)
    return thin.make_scene(**({"mesh": mesh, "dt": 1e-4, "rope": rope, "gravity": NOTHING} | changes))


def shaken(mesh, size=0.02, speed=0.5, seed=0):
    rng = np.random.default_rng(seed)
    x, v = (s * rng.standard_normal(mesh.vertices.shape) for s in (size, speed))
    return thin.initial_state(mesh.vertices + x).replace(v=jnp.asarray(v))


def run(scene, state, num_substeps):
    return STEP(scene, state, thin.static_poses(num_substeps, dtype=state.x.dtype))


KINDS = {
    "StVK": lambda **k: (cloth_scene(**k), SHEET),
    "hinges": lambda **k: (cloth_scene(bending_law=thin.BendingLaw.HINGES, **k), SHEET),
    "neo-Hookean": lambda **k: (cloth_scene(law=thin.MembraneLaw.NEO_HOOKEAN, **k), SHEET),
    "rope": lambda **k: (rope_scene(**k), LINE),
}


def hessian(scene, x):
    """Second derivative of the elastic energy, shape (3 num_vertices, 3 num_vertices)."""
    return _HESSIAN(scene, jnp.asarray(x).reshape(-1))


_HESSIAN = jax.jit(
    jax.hessian(lambda scene, flat: thin.elastic_energy(scene, thin.initial_state(flat.reshape(-1, 3))), argnums=1)
)


def free(scene):
    """Mask of the free coordinates, shape (3 num_vertices,)."""
    return np.repeat(np.asarray(scene.mobility) > 0, 3)


def equilibrium(scene, x, iterations=40):
    """Vertices at rest under gravity, by damped Newton steps on the potential energy."""
    move, shape = free(scene), x.shape

    def potential(flat):
        state = thin.initial_state(flat.reshape(shape))
        return thin.elastic_energy(scene, state) + thin.gravitational_energy(scene, state)

    value, slope, curvature = jax.jit(potential), jax.jit(jax.grad(potential)), jax.jit(jax.hessian(potential))
    x = np.array(x, np.float64).reshape(-1)
    for _ in range(iterations):
        g, H = np.asarray(slope(x))[move], np.asarray(curvature(x))[np.ix_(move, move)]
        values, vectors = np.linalg.eigh(H)
        step = -vectors @ ((vectors.T @ g) / np.maximum(np.abs(values), 1e-6 * np.abs(values).max()))
        size = 1.0
        while size > 1e-6:
            new = x.copy()
            new[move] += size * step
            if value(new) <= value(x):
                break
            size *= 0.5
        x = new
        if np.abs(step).max() < 1e-10:
            break
    return x.reshape(shape)
