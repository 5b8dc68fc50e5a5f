"""Checks of a shape as a solid: its bounds, volume, inertia and pictures."""

import jax
import jax.numpy as jnp
import numpy as np

from rewax.physics.contact import Collider, drawings
from rewax.physics.numerics import Pose
from rewax.testing.shape_points import Sample, at
from rewax.viz import shapes

_TIGHT = 0.1
"""Share of the longest edge by which a bounding box may exceed the solid."""
_VOLUME = 4e-3
"""Largest joint error of random points and quadrature, relative to the volume of the bounding box."""
_AXES = "xyz"


def check_bounds(sample: Sample) -> None:
    """Checks that bounding box and bounding ball contain the solid, and that the box is tight."""
    middle, half = 0.5 * (sample.lower + sample.upper), 0.5 * (sample.upper - sample.lower)
    around = middle + half * sample.rng.uniform(-2.0, 2.0, (20_000, 3))
    points = np.concatenate([around, sample.random, sample.special])
    inside = points[sample.distance(points)[0] < 0]
    slack = 1e-6 * sample.size
    beyond = ((inside < sample.lower - slack) | (inside > sample.upper + slack)).any(axis=1)
    name = sample.name
    assert not beyond.any(), (
        f"{at(inside[beyond][0])} lies inside of {name}, but beyond its bounding_box, which reaches from "
        f"{at(sample.lower)} to {at(sample.upper)}: enlarge it"
    )
    surface = np.concatenate([sample.surface, inside])
    low, high = surface.min(axis=0), surface.max(axis=0)
    for i, axis in enumerate(_AXES):
        for side, face, found in (("lower", sample.lower[i], low[i]), ("upper", sample.upper[i], high[i])):
            assert abs(face - found) <= _TIGHT * sample.size, (
                f"the {side} bound of {name} along {axis} is {face:.4g}, but the solid reaches to {found:.4g} only: "
                "tighten bounding_box, or filling takes long"
            )
    farthest, radius = float(np.linalg.norm(surface, axis=1).max()), float(sample.shape.bounding_radius())
    assert farthest <= radius * (1.0 + 1e-4), (
        f"bounding_radius of {name} is {radius:.4g}, but {farthest:.4g} from the origin it is still solid: enlarge it"
    )


def check_volume(sample: Sample) -> None:
    """Checks the volume by random points, and its derivative by a finite difference."""
    inside, whole = sample.inside[1], float(np.prod(sample.upper - sample.lower))
    expected, found = inside.mean() * whole, float(sample.shape.volume())
    assert abs(found - expected) <= _VOLUME * whole, (
        f"volume of {sample.name} is {found:.6g} m^3, but random points inside stand for {expected:.6g} m^3: correct "
        "it, or leave the method out"
    )
    with jax.enable_x64(True):
        tangents = jax.tree.map(lambda a: 0.01 * jnp.abs(a), sample.exact)
        along = jax.jit(lambda shape: jax.jvp(lambda shape: shape.volume(), (shape,), (tangents,)))
        slope = float(along(sample.exact)[1])
        moved = [jax.tree.map(lambda a, t, s=s: a + s * t, sample.exact, tangents) for s in (0.5, -0.5)]
        difference = float(along(moved[0])[0] - along(moved[1])[0])
    assert abs(slope - difference) <= 0.02 * max(abs(difference), 0.01 * expected), (
        f"if all sizes of {sample.name} grow by 1 %, its volume grows by {difference:.4g} m^3, but its derivative says "
        f"{slope:.4g}: compute it with jnp from the sizes, without stop_gradient"
    )


def check_inertia(sample: Sample) -> None:
    """Checks mass and moments by random points, if the centre of mass is the origin."""
    points = sample.inside[0][sample.inside[1]]
    if np.abs(points.mean(axis=0)).max() > 5e-3 * sample.size:
        return
    try:
        mass, moment = sample.shape.inertia(2.0)
    except ValueError as error:
        raise AssertionError(str(error)) from error
    expected, second = 2.0 * float(sample.shape.volume()), points.T @ points / len(points)
    assert abs(float(mass) - expected) <= 1e-3 * expected, (
        f"inertia of {sample.name} gives a mass of {float(mass):.6g} kg at a density of 2 kg/m^3, but twice the volume "
        f"is {expected:.6g} kg: return density * volume first"
    )
    wanted = expected * (np.trace(second) * np.eye(3) - second)
    right = np.abs(np.asarray(moment) - wanted) <= 0.02 * wanted.max()  # false for NaN
    assert right.all(), (
        f"moments of inertia of {sample.name} are {np.asarray(moment).round(6).tolist()}, but those of random points "
        f"inside are {wanted.round(6).tolist()}: correct them, or leave the method out"
    )


def check_drawings(sample: Sample) -> None:
    """Checks that the result of ``draw`` can be drawn and has the extent of the bounding box."""
    still = Pose(jnp.zeros((1, 3)), jnp.eye(3)[None])
    try:
        found = drawings([Collider(shape=sample.shape, friction=0.0)], still)
        low, high = shapes.bounds(found)
    except ValueError as error:
        raise AssertionError(f"draw of {sample.name} returns what cannot be drawn: {error}") from error
    if not found or not sample.shape.is_bounded:
        return
    off = max(np.abs(low - sample.lower).max(), np.abs(high - sample.upper).max())
    assert off <= 1.5 * _TIGHT * sample.size, (
        f"the picture of {sample.name} reaches from {at(low)} to {at(high)}, but its bounding_box from "
        f"{at(sample.lower)} to {at(sample.upper)}: draw it in the shape's own frame, or leave the method out"
    )
    for drawing in found:
        if drawing["kind"] == "mesh":
            off = np.abs(sample.distance(np.asarray(drawing["vertices"], np.float64))[0]).max()
            assert off <= 0.5 * _TIGHT * sample.size, (
                f"a vertex in the picture of {sample.name} is {off:.4g} m from its surface: draw the surface"
            )


__all__ = ["check_bounds", "check_drawings", "check_inertia", "check_volume"]
