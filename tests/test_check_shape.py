"""``check_shape`` passes every built-in shape and a user's, and names what is wrong with broken ones."""

import re
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from native_cases import NEEDS_COMPILER
from own_shapes import Torus, Union

from rewax import struct
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.checks import POSITIVE
from rewax.physics.shapes import (
    Box,
    Capsule,
    Cone,
    Cylinder,
    Ellipsoid,
    HeightField,
    Plane,
    SampledDistance,
    Shape,
    Sphere,
)
from rewax.testing import check_shape
from rewax.testing.shape_distance import check_normals, check_values
from rewax.testing.shape_points import Sample
from rewax.testing.shape_programs import _check_same, check_programs
from rewax.testing.shape_rays import check_rays
from rewax.testing.shape_solid import check_bounds, check_drawings, check_inertia, check_volume
from rewax.types import Scalar

NODES = np.indices((25, 25, 25)) * 0.05 - 0.6
HEIGHTS = 0.1 * np.sin(np.arange(5))[:, None] * np.cos(np.arange(6))
SHAPES = {
    "sphere": Sphere(radius=0.4),
    "capsule": Capsule(radius=0.3, half_length=0.2),
    "box": Box(half_size=(0.2, 0.3, 0.5)),
    "cylinder": Cylinder(radius=0.3, half_length=0.5),
    "cone": Cone(radius=0.3, half_length=0.5),
    "ellipsoid": Ellipsoid(semi_axes=(0.2, 0.3, 0.5)),
    "plane": Plane(),
    "baked": SampledDistance(values=np.linalg.norm(NODES, axis=0) - 0.41, origin=(-0.6, -0.6, -0.6), spacing=0.05),
    "terrain": HeightField(heights=HEIGHTS, origin=(-0.8, -0.9), spacing=0.4),
    "torus": Torus(ring=0.3, tube=0.1),
    "union": Union(first=Sphere(radius=0.3), second=Box(half_size=(0.4, 0.1, 0.1))),
}
IN_XLA = {"baked": "it has more than 5000 operations", "terrain": "it has indices that depend on its arguments"}
"""What runs in XLA, and why."""


@NEEDS_COMPILER
@pytest.mark.parametrize("name", SHAPES)
def test_shapes_pass(name):
    said = []
    check_shape(SHAPES[name], notify=said.append)
    kind = type(SHAPES[name]).__name__
    assert said[0] == f"check_shape {kind}, 0 s: sizes" and said[-1].endswith(": passed")
    slow = [line.split("slower than in C++: ")[1] for line in said if "in XLA" in line]
    assert [line.removesuffix(" (docs/lowering.md)") for line in slow] == ([IN_XLA[name]] if name in IN_XLA else [])
    assert any("bounds" in line for line in said) == (name not in ("plane", "terrain"))


def torus(**methods) -> Shape:
    """A torus whose class has other methods or attributes."""
    return struct.dataclass(type("Broken", (Torus,), methods))(ring=0.3, tube=0.1)


def bent(change):
    """A torus with distance and normal changed: ``change(self, p, d, n)``."""
    return torus(distance=lambda self, p: change(self, p, *Torus.distance(self, p)))


def blind(self, p):
    """Roots whose derivatives are infinite on the axis and on the circle."""
    from_axis = jnp.sqrt(p[0] * p[0] + p[2] * p[2])
    from_circle = jnp.sqrt((from_axis - self.ring) ** 2 + p[1] * p[1])
    safe = Torus.distance(self, p)
    return from_circle - self.tube, safe[1]


def box(scale):
    half = jnp.array([0.4, 0.1, 0.4])
    return torus(bounding_box=lambda self: (-scale * half, scale * half))


@struct.dataclass
class Undeclared(Torus):
    """A size without a range."""

    extra: Scalar = 1.0


@struct.dataclass
class Unused(Torus):
    """A size without an effect."""

    extra: Scalar = struct.number(POSITIVE, "give a length in metres", default=1.0)


class Bare(Torus):
    """Not decorated."""


class Lists(Sphere):
    """Not even a tuple."""

    def distance(self, p):
        return list(super().distance(p))


def ellipse(self, p):
    """A bound that is no distance: it shrinks the tube along y."""
    return Torus(ring=self.ring, tube=self.tube).distance((p[0], 1.5 * p[1], p[2]))


def scale(factor, d, n):
    return factor * d, n


BROKEN = {
    "a torus": ("ball", "shape is 'ball': give a shape of rewax.physics.shapes, or of a class derived from Shape"),
    "bare": (Bare(ring=0.3, tube=0.1), "shape is a Bare, which is no pytree: decorate it with rewax.struct.dataclass"),
    "illegal": (Torus(ring=0.3, tube=-0.1), "Torus.tube is -0.1"),
    "undeclared": (Undeclared(ring=0.3, tube=0.1), "Undeclared.extra does not say what it may be: declare it with"),
    "unused": (Unused(ring=0.3, tube=0.1), "the distance does not depend on Unused.extra: use it"),
    "no distance": (torus(distance=Shape.distance), "Broken has no distance: write its method distance(self, p)"),
    "only a distance": (torus(distance=lambda self, p: p[0]), "distance of Broken returns "),
    "a constant": (bent(lambda self, p, d, n: (d, (n[0], 0.0, n[2]))), "distance of Broken returns arrays of shapes"),
    "a Python number": (
        bent(lambda self, p, d, n: (d + 0.0 * float(self.tube), n)),
        "distance of Broken cannot be compiled with traced parameters (",
    ),
    "single precision": (
        bent(lambda self, p, d, n: (d.astype(jnp.float32), n)),
        "distance of Broken returns float32 and float64 for points of float64: write Python numbers",
    ),
    "a hole": (bent(lambda self, p, d, n: (jnp.where(p[1] > 0.2, jnp.nan, d), n)), "the distance at ("),
    "a long normal": (bent(lambda self, p, d, n: (d, cp.scale(2.0, n))), "the normal at ("),
    "nothing": (bent(lambda self, p, d, n: (jnp.abs(d) + self.tube, n)), "the distance is positive at all of "),
    "inwards": (bent(lambda self, p, d, n: (d, cp.scale(-1.0, n))), "the normal at ("),
    "another normal": (bent(lambda self, p, d, n: (d, cp.unit(p)[1])), "the normal at ("),
    "twice as far": (bent(lambda self, p, d, n: (2.0 * d, n)), "at ("),
    "a step": (bent(lambda self, p, d, n: (d + 0.1 * jnp.floor(1e5 * p[1]), n)), "the distance jumps at "),
    "not the nearest": (
        bent(lambda self, p, d, n: (d + 0.15 * (d > 0.3), n)),
        "(",
    ),
    "roots": (torus(distance=blind), "a derivative of distance or normal at ("),
    "cut": (
        bent(lambda self, p, d, n: (d + 0.5 * (self.tube - jax.lax.stop_gradient(self.tube)), n)),
        "the derivative of the distance by Broken.tube at (",
    ),
    "a rigid normal": (
        bent(lambda self, p, d, n: (d, jax.lax.stop_gradient(n))),
        "the derivative of the normal by Broken.ring at (",
    ),
    "a slow distance": (
        torus(is_exact=False, distance=lambda self, p: scale(1e-3, *Torus.distance(self, p))),
        "twenty steps of the distance along the normal lead from ",
    ),
    "an ellipse": (torus(distance=ellipse), "the normal at ("),
    "a small box": (box(0.8), "("),
    "a large box": (box(1.5), "the lower bound of Broken along x is -0.6, but the solid reaches to -0."),
    "a box upside down": (box(-1.0), "the bounding box of Broken reaches from (0.4, 0.1, 0.4) to (-0.4, -0.1, -0.4): its"),
    "a box of numpy": (
        torus(bounding_box=lambda self: (-np.array([self.ring + self.tube] * 3), np.full(3, 0.4))),
        "bounding_radius of Broken cannot be compiled with traced parameters (",
    ),
}  # fmt: skip


BROKEN_SOLID = {
    "a small radius": (
        check_bounds, torus(bounding_radius=lambda self: self.ring),
        "bounding_radius of Broken is 0.3, but 0.4 from the origin it is still solid: enlarge it",
    ),
    "half the volume": (
        check_volume, torus(volume=lambda self: 0.5 * Torus.volume(self)),
        "volume of Broken is 0.029",
    ),
    "a volume without a derivative": (
        check_volume, torus(volume=lambda self: jax.lax.stop_gradient(Torus.volume(self))),
        "if all sizes of Broken grow by 1 %, its volume grows by 0.00",
    ),
    "mass without density": (check_inertia, torus(inertia=lambda self, _: Torus.inertia(self, 1.0)), "inertia of Broken gives a mass of "),
    "a round moment": (
        check_inertia, torus(inertia=lambda self, density: (Torus.inertia(self, density)[0], jnp.eye(3) * 0.006)),
        "moments of inertia of Broken are [[0.006",
    ),
    "a moment that is no number": (
        check_inertia, torus(inertia=lambda self, density: (Torus.inertia(self, density)[0], jnp.eye(3) * jnp.nan)),
        "moments of inertia of Broken are [[nan",
    ),
    "rays that miss": (
        check_rays, torus(cast=lambda self, origin, direction: jnp.full_like(origin[0], jnp.inf)), "a ray from (",
    ),
    "rays through the hole": (
        check_rays, torus(cast=lambda self, *ray: Sphere(radius=0.4).cast(*ray)), "a ray from (",
    ),
    "rays in metres": (
        check_rays, torus(cast=lambda self, o, d: cp.norm(d) * Torus.cast(self, o, d)), "a direction that is three times as long ",
    ),
    "rays backwards": (check_rays, torus(cast=lambda self, o, d: -Torus.cast(self, o, d)), "cast of Broken returns (-"),
    "rays from inside": (
        check_rays, torus(cast=lambda self, o, d: jnp.where(self.distance(o)[0] < 0, 0.1, Torus.cast(self, o, d))),
        "a ray from (",
    ),
    "no drawing": (check_drawings, torus(draw=lambda self: [{"kind": "ring"}]), "draw of Broken returns what cannot be drawn: cannot draw"),
    "a large drawing": (
        check_drawings, torus(draw=lambda self: [{"kind": "sphere", "center": np.zeros(3), "radius": self.ring + self.tube}]),
        "the picture of Broken reaches from (-0.4, -0.4, -0.4) to (0.4, 0.4, 0.4), but its bounding_box",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("shape", "sentence"), BROKEN.values(), ids=BROKEN)
def test_what_is_wrong_gets_one_sentence(shape, sentence):
    with pytest.raises(AssertionError, match="^" + re.escape(sentence)) as error:
        check_shape(shape, notify=None)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("check", "shape", "sentence"), BROKEN_SOLID.values(), ids=BROKEN_SOLID)
def test_what_is_wrong_with_a_solid_gets_one_sentence(check, shape, sentence):
    with pytest.raises(AssertionError, match="^" + re.escape(sentence)) as error:
        check(Sample(shape, jax.random.key(0), None))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("found", [np.nan, np.inf, 2.0])
def test_programs_that_give_other_numbers_are_found_though_they_are_not_finite(found):
    sample, right = SimpleNamespace(name="Broken"), np.array([1.0, np.inf, np.nan])
    _check_same(sample, "jit", right, right)
    with pytest.raises(AssertionError, match="jit changes numbers of distance of Broken"):
        _check_same(sample, "jit", np.array([found, np.inf, np.nan]), right)
    with pytest.raises(AssertionError, match="jit changes numbers of distance of Broken"):
        _check_same(sample, "jit", np.array([1.0, found, np.nan]), np.where(right == found, 3.0, right))


def test_a_bound_is_legal_where_it_says_so():
    """A distance that shrinks by 0.7 misleads nobody about the surface."""
    scaled = torus(is_exact=False, distance=lambda self, p: scale(0.7, *Torus.distance(self, p)))
    sample = Sample(scaled, jax.random.key(0), None)
    check_values(sample)
    check_normals(sample, tolerance=0.1)
    check_rays(sample)


def test_what_python_remembers_is_found():
    def distance(self, p):
        d, n = Torus.distance(self, p)
        return d + (1e-2 if isinstance(p[0], jax.core.Tracer) else 0.0), n

    with pytest.raises(AssertionError, match=r"^jit changes numbers of distance of Broken, "):
        check_programs(Sample(torus(distance=distance), jax.random.key(0), None))


def test_other_keys_and_regions_draw_other_points():
    check_shape(Sphere(radius=0.1), region=((-0.3,) * 3, (0.3,) * 3), notify=None)
    check_shape(Plane(), key=jax.random.key(1), region=((0.0, -0.1, 0.0), (1.0, 0.1, 1.0)), notify=None)
    with pytest.raises(AssertionError, match="give a region that the surface crosses"):
        check_shape(Plane(), region=((0.0, 100.0, 0.0), (1.0, 101.0, 1.0)), notify=None)
