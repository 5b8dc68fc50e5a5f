"""Each kind of scene has its solver; splitting a state and joining it gives it back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tet_bodies
import thin_bodies
from flat_materials import flat_material

from rewax.physics import mpm, tets, thin
from rewax.physics.coupling.soft import PARTICLES, TETRAHEDRA, THIN, prescribed_of, solver_of
from rewax.physics.mpm import Grid


def particles():
    material = flat_material(youngs_modulus=1e3, poissons_ratio=0.3, density=1e3)
    scene = mpm.make_scene(grid=Grid(shape=(8, 8, 8), spacing=0.5), dt=1e-3, particle_volume=1e-3, material=material)
    x = jnp.asarray(np.random.default_rng(0).uniform(1.0, 2.0, (5, 3)), jnp.float32)
    return scene, mpm.initial_state(x)


def vertices():
    scene, state = tet_bodies.body()
    return scene, tet_bodies.shaken(state)


def cloth():
    scene = thin_bodies.cloth_scene()
    return jax.tree.map(lambda a: a.astype(jnp.float32), (scene, thin_bodies.shaken(thin_bodies.SHEET)))


@pytest.mark.parametrize(("body", "solver"), [(particles, PARTICLES), (vertices, TETRAHEDRA), (cloth, THIN)])
def test_a_scene_has_its_solver(body, solver):
    scene, state = body()
    assert solver_of(scene) is solver
    back = solver.join(solver.split(state))
    jax.tree.map(np.testing.assert_array_equal, back, state)


@pytest.mark.parametrize("body", [particles, vertices, cloth])
def test_a_substep_without_bodies_is_that_of_the_solver(body):
    scene, state = body()
    solver = solver_of(scene)

    @jax.jit
    def coupled(scene, state):
        return solver.join(solver.begin(scene, solver.constants(scene, state), solver.split(state)).finish())

    step = {particles: mpm.step, vertices: tets.step, cloth: thin.step}[body]
    alone = jax.jit(step)(scene, state, mpm.static_poses(1))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), coupled(scene, state), alone)


def test_what_is_no_scene_is_refused():
    with pytest.raises(ValueError, match=r"^scene is \{\}: give a scene of mpm\.make_scene, tets\.make_scene, thin"):
        solver_of({})


def test_pins_and_grips_are_for_cloth_alone():
    for given in ({"pins": np.zeros((1, 1, 3)), "grips": None}, {"pins": None, "grips": np.zeros(1)}):
        name = "grips" if given["pins"] is None else "pins"
        with pytest.raises(ValueError, match=f"^{name} is given, but the scene has no cloth"):
            prescribed_of(*vertices(), **given, num_substeps=1, num_bodies=0)


def test_implicit_steps_and_creases_are_not_coupled():
    scene, state = cloth()
    with pytest.raises(ValueError, match=r"stepper is a thin\.Implicit, but coupled bodies take explicit steps"):
        prescribed_of(scene.replace(stepper=thin.Implicit()), state, None, None, 1, 1)
    yielding = scene.cloth.replace(yield_curvature=jnp.float32(10.0))
    with pytest.raises(ValueError, match="cloth that is coupled with bodies or particles cannot keep creases"):
        prescribed_of(scene.replace(cloth=yielding), state, None, None, 1, 1)


def test_the_state_of_another_solver_is_refused():
    with pytest.raises(ValueError, match=r"^state is a MPMState, but scene a ThinScene: give a ThinState"):
        prescribed_of(cloth()[0], particles()[1], None, None, 1, 1)
    scene, state = cloth()
    with pytest.raises(ValueError, match="crease is given, but the cloth does not yield"):
        prescribed_of(scene, thin.no_creases(scene, state), None, None, 1, 1)
