"""The machine runs what particles, nodes, vertices and tets do alone: a new operation would be slow without a word."""

import jax
import jax.numpy as jnp
import material_cases as cases
import numpy as np
import pytest
from own_shapes import Torus

from rewax.lowering import build, kernels
from rewax.physics.contact import Collider, Ground, PenaltyContact, collider_force, ground_force, place
from rewax.physics.contact.colliders import apply_colliders
from rewax.physics.mpm import Muscle, Newtonian
from rewax.physics.mpm.materials import split_parameters
from rewax.physics.mpm.stepping import stress_and_momentum
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Box, Capsule, Cone, Cylinder, Ellipsoid, Plane, Sphere
from rewax.physics.tets.law import DampingLaw
from rewax.physics.tets.stepping import Vertices, _columns, _moved

NUM = 4
ONES = jnp.ones(NUM)
VECTOR = (ONES, ONES, ONES)
MATRIX = (VECTOR, VECTOR, VECTOR)
SHAPES = [
    Sphere(radius=0.3), Capsule(radius=0.3, half_length=0.2), Box(half_size=jnp.ones(3)), Plane(),
    Cylinder(radius=0.3, half_length=0.2), Cone(radius=0.3, half_length=0.2), Ellipsoid(semi_axes=jnp.ones(3)),
    Torus(ring=0.3, tube=0.1),
]  # fmt: skip


@pytest.fixture
def assembled(monkeypatch):
    """Which of value, jvp and vjp were assembled; all must succeed."""
    names = set()

    def assemble(which, program, avals, varies, precision):
        bytecode, dtype, outputs = kernels.bytecode_of(which, program, avals, varies)
        assert len(bytecode.code) and dtype == np.float32 and outputs
        names.add(which)
        return "it is only written"

    monkeypatch.setattr(kernels, "target_of", assemble)
    monkeypatch.setattr(build, "compiler", lambda: "c++")
    monkeypatch.setattr(build, "is_off", lambda: False)
    return names


def assert_assembled(assembled, function, *args):
    """Value, forward and reverse derivative by all floating-point arguments."""

    def total(*args):
        return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(function(*args)))

    args = jax.tree.map(jnp.asarray, args)
    jax.jit(jax.value_and_grad(total, argnums=tuple(range(len(args))))).lower(*args)
    jax.jit(lambda *args: jax.jvp(total, args, args)).lower(*args)
    assert assembled == {"value", "tangent", "cotangent"}


@pytest.mark.parametrize(("elasticity", "plasticity"), cases.LAWS)
def test_laws(assembled, elasticity, plasticity):
    material = cases.material(elasticity, plasticity, dtype=np.float32)
    muscle = Muscle(fibre=jnp.ones((NUM, 3)), activation=1.0)
    material = material.replace(viscosity=Newtonian(viscosity=ONES), muscle=muscle)
    shared, own = split_parameters(material)
    assert set(own) == {"viscosity.viscosity", "muscle.fibre"}
    particles = jnp.ones((24 + len(material.initial_memory), NUM))
    assert_assembled(assembled, lambda s, *p: stress_and_momentum((s, 1e-3), p), shared, own, particles, ONES, ONES)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: type(s).__name__)
def test_colliders(assembled, shape):
    collider = Collider(shape=shape, friction=0.5, softness=100.0)
    pose = Pose(jnp.zeros((1, 3)), jnp.eye(3)[None])

    def velocity(collider, velocity):
        placed = jax.tree.map(lambda a: a[0], place([collider], pose, pose, 1e-3))
        return apply_colliders([(collider, placed)], VECTOR, velocity)

    assert_assembled(assembled, velocity, collider, VECTOR)
    assembled.clear()
    contact = PenaltyContact(stiffness=ONES, damping=1.0, friction_damping=ONES, onset=0.1)
    one = Pose(jnp.zeros(3), jnp.eye(3))
    assert_assembled(assembled, lambda *a: collider_force(*a, one, one, 1e-3), collider, contact, VECTOR, VECTOR)


def test_the_ground(assembled):
    contact = PenaltyContact(stiffness=1.0, friction=0.5, friction_damping=1.0)
    assert_assembled(assembled, ground_force, Ground(normal=jnp.array([0.0, 1.0, 0.0])), contact, VECTOR, VECTOR)


@pytest.mark.parametrize("damping_law", DampingLaw)
def test_tets(assembled, damping_law):
    own, shared = (ONES, None, None, ONES), (None, 1.0, 0.0, None)
    assert_assembled(assembled, _columns(damping_law), shared, (own, (MATRIX, ONES), (MATRIX, MATRIX)))
    assembled.clear()
    assert_assembled(assembled, _moved, (jnp.ones(3), 1e-3), (Vertices(VECTOR, VECTOR), VECTOR, VECTOR, ONES, ONES))
