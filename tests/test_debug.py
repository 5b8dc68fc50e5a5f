"""locate_nan names the substep, the field and the particle at which a simulation broke."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flat_materials import flat_material

from rewax.debug import locate_nan
from rewax.physics import mpm
from rewax.physics.contact.colliders import Collider
from rewax.physics.mpm.grid import Grid
from rewax.physics.shapes import Sphere
from rewax.physics.shapes.sampling import fill_box

NUM_SUBSTEPS = 6


@pytest.fixture(scope="module")
def falling():
    """A cube of 27 particles far above a ball that rests: (scene, state, poses)."""
    ball = Collider(shape=Sphere(radius=0.1), offset=jnp.zeros(3), rotation=jnp.eye(3), friction=0.5)
    scene = mpm.make_scene(
        grid=Grid(shape=(10, 10, 10), spacing=0.1), dt=1e-3, particle_volume=1e-4, colliders=(ball,),
        material=flat_material(youngs_modulus=1e3, poissons_ratio=0.3, density=1e3),
    )  # fmt: skip
    state = mpm.initial_state(jnp.asarray(fill_box((0.5, 0.5, 0.5), (0.15, 0.15, 0.15), 0.05)), scene)
    return scene, state, mpm.static_poses(NUM_SUBSTEPS, 1)


def test_nothing_is_found_where_nothing_is_wrong(falling):
    assert locate_nan(*falling) is None


@pytest.mark.parametrize("field", ["x", "v", "C", "F"])
def test_what_is_broken_from_the_start(falling, field):
    scene, state, poses = falling
    value = getattr(state, field)
    broken = state.replace(**{field: value.at[(11, *[0] * (value.ndim - 1))].set(jnp.inf)})
    found = locate_nan(scene, broken, poses)
    assert (found.substep, found.field, found.particle) == (-1, field, 11)


def test_the_substep_at_which_it_breaks(falling):
    """A particle that spins far too fast is stretched until a square overflows."""
    scene, state, poses = falling
    broken = state.replace(C=state.C.at[4, 0, 0].set(1e17))
    one = jax.jit(mpm.substep)
    before, count = broken, 0
    while True:
        new = one(scene, before, *(jax.tree.map(lambda p: p[0], poses),) * 2)
        if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(new)):
            break
        before, count = new, count + 1
    found, with_new_lists = (locate_nan(scene, broken, poses, list_every=every) for every in (None, 1))
    assert 0 < count == found.substep == with_new_lists.substep
    bad = np.isfinite(np.asarray(getattr(new, found.field)).reshape(len(new.x), -1)).all(axis=1)
    assert found.particle == np.argmin(bad)
    np.testing.assert_allclose(found.before["x"], before.x[found.particle], atol=1e-7)
    assert f"{found.field} of particle {found.particle} is not finite in substep {count}; before: x [" in str(found)


def test_lists_of_active_nodes_are_made_as_often_as_the_task_makes_them(falling, monkeypatch):
    made = []
    monkeypatch.setattr(mpm, "nodes_of_step", lambda scene, x, f=mpm.nodes_of_step: made.append(x) or f(scene, x))
    with jax.disable_jit():
        for every, count in ((None, 1), (2, 3), (4, 2)):
            made.clear()
            assert locate_nan(*falling, list_every=every) is None
            assert len(made) == count, every
    with pytest.raises(ValueError, match="list_every is 0: give 1 or more"):
        locate_nan(*falling, list_every=0)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"scene": None}, "scene is None: give that of the environment"),
        ({"state": 3.0}, "state is 3.0: give particles, state.physics.soft"),
        ({"poses": None}, "poses is None: give poses of the scene's bodies"),
    ],
)
def test_arguments_of_another_type_are_refused(falling, change, sentence):
    with pytest.raises(ValueError, match=f"^{sentence}"):
        locate_nan(**{**dict(zip(("scene", "state", "poses"), falling, strict=True)), **change})
