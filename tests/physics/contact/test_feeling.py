"""The scan with touch: the solver's state passes through, what patches receive is averaged over the substeps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rewax.physics.contact import Patches, Wrench
from rewax.physics.contact.feeling import scan_touch
from rewax.physics.numerics import Pose

NUM = 4
POSES = Pose(jnp.zeros((NUM + 1, 2, 3)), jnp.broadcast_to(jnp.eye(3), (NUM + 1, 2, 3, 3)))
PATCHES = {"both": Patches(body=(0, 1)), "one": Patches(body=(1,))}
PUSHES = jnp.array([1.0, 2.0, 4.0, 9.0])
WEIGHTS = {"both": jnp.array([[1.0], [3.0]]), "one": jnp.array([[3.0]])}


def pushed(x, pushes, **options):
    """Each push moves x; body 1 receives three times as much of it as body 0, and half of that as torque."""

    def substep(carry, push):
        force = {name: weight * push * jnp.ones(3) for name, weight in WEIGHTS.items()}
        return carry.after(carry.soft + push * carry.soft, {name: Wrench(f, 0.5 * f) for name, f in force.items()})

    return scan_touch(substep, x, pushes, POSES, PATCHES, **options)


@pytest.mark.parametrize("store_every", [None, 1, 2])
def test_forces_are_means_over_the_substeps(store_every):
    x, felt = pushed(jnp.ones(3), PUSHES, store_every=store_every)
    np.testing.assert_allclose(x, np.prod(1.0 + np.asarray(PUSHES)))
    for name, weight in WEIGHTS.items():
        np.testing.assert_allclose(felt[name].force, np.asarray(weight) * np.full(3, 4.0))
        np.testing.assert_allclose(felt[name].torque, np.asarray(weight) * np.full(3, 2.0))


def test_impulses_become_forces():
    _, felt = pushed(jnp.ones(3), PUSHES, store_every=None, dt=0.5)
    np.testing.assert_allclose(felt["one"].force, np.full((1, 3), 3.0 * 16.0 / (NUM * 0.5)))


def test_the_gradient_is_that_of_the_mean():
    slope = jax.grad(lambda pushes: pushed(jnp.ones(3), pushes, store_every=2)[1]["one"].force[0, 0])(PUSHES)
    np.testing.assert_allclose(slope, np.full(NUM, 3.0 / NUM))


def test_a_patch_needs_a_body():
    with pytest.raises(ValueError, match="a patch belongs to body 2, but there are 2 bodies"):
        scan_touch(lambda carry, _: carry, jnp.ones(3), PUSHES, POSES, Patches(body=(2,)), store_every=None)


def test_a_mean_needs_a_substep():
    still = jax.tree.map(lambda a: a[:1], POSES)
    with pytest.raises(ValueError, match="poses has one boundary and so no substep"):
        scan_touch(lambda carry, _: carry, jnp.ones(3), PUSHES[:0], still, PATCHES, store_every=None)
