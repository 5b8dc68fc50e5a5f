"""What laws share: stretches with the sign of the volume, elongation without rounding, and what is to be written."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

from rewax import struct
from rewax.physics.mpm import Material
from rewax.physics.mpm.laws import Elasticity, Flow, Fluid, Hencky, Plasticity, Viscosity
from rewax.physics.mpm.laws.base import MIN_STRETCH, ActiveStress, LogarithmicPlasticity, elongation_of, stretches
from rewax.physics.mpm.materials import respond
from rewax.physics.numerics import components as cp
from rewax.physics.numerics.divided_differences import Principal

ONE = np.ones(())


def test_stretches_are_roots_and_the_smallest_has_the_sign_of_the_volume(x64):
    eigenvalues = Principal(tuple(jnp.asarray(a) for a in (4.0, 0.25, 2.25)))
    np.testing.assert_allclose(np.stack(stretches(eigenvalues, ONE).values), [2.0, 0.5, 1.5], rtol=1e-15)
    np.testing.assert_allclose(np.stack(stretches(eigenvalues, -ONE).values), [2.0, -0.5, 1.5], rtol=1e-15)
    flat = stretches(Principal((ONE, 0.0 * ONE, ONE)), ONE)
    np.testing.assert_allclose(np.stack(flat.values), [1.0, MIN_STRETCH, 1.0], rtol=1e-12)


def test_elongation_is_new_over_old_minus_one_and_exactly_zero_where_nothing_changes(x64):
    s = Principal(tuple(jnp.asarray(a) for a in (1.1, 0.7, 1e-3)))
    change = Principal(tuple(jnp.asarray(a) for a in (-0.1, 0.05, 0.0)))
    found = np.stack(elongation_of(s, s, change).values)
    np.testing.assert_allclose(found, [np.expm1(-0.1), np.expm1(0.05), 0.0], rtol=1e-13)
    assert found[2] == 0.0
    floor = Principal(tuple(jnp.asarray(a) for a in (1.1, 0.7, 1e-2)))
    np.testing.assert_allclose(np.stack(elongation_of(s, floor).values), [0.0, 0.0, 9.0], rtol=1e-13)


@pytest.mark.parametrize(
    ("kind", "method", "args"),
    [
        (Elasticity, "moduli", 0), (Elasticity, "principal_stress", 1), (Elasticity, "energy", 1),
        (Fluid, "stress", 2), (Fluid, "energy_of_volume", 2), (Plasticity, "flow", 3),
        (LogarithmicPlasticity, "return_map", 2), (Viscosity, "stress", 2), (Viscosity, "dynamic_viscosity", 0),
        (ActiveStress, "stress", 1),
    ],
)  # fmt: skip
def test_a_law_without_a_method_says_which(kind, method, args):
    class Mine(kind):
        pass

    with pytest.raises(
        NotImplementedError, match=rf"^Mine has no {method}\(.*\): define it, see docs/your_own_law.md$"
    ):
        getattr(Mine(), method)(*[None] * args)


FORMS = {
    "no flow": (Plasticity, "flow", lambda self, s, *_: (s, 0.0 * s.values), "Mine.flow returned (Stretches("),
    "no stretches": (
        Plasticity, "flow", lambda self, s, *_: Flow(s.values, 0.0 * s.values), "Mine.flow returned stretches Principal(",
    ),
    "a number as elongation": (
        Plasticity, "flow", lambda self, s, *_: Flow(s, 0.0), "Mine.flow returned elongation 0.0: return a Principal",
    ),
    "memory without a tuple": (
        Plasticity, "flow", lambda self, s, *_: Flow(s, 0.0 * s.values, s.volume), "Mine.flow returned memory ",
    ),
    "too much memory": (
        Plasticity, "flow", lambda self, s, *_: Flow(s, 0.0 * s.values, (s.volume,)),
        "Mine.flow returned 1 entries of memory, but initial_memory has 0: return one for each",
    ),
    "stress on one axis": (
        Hencky, "principal_stress", lambda self, s: s.volume - 1.0, "Mine.principal_stress returned ",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("kind", "method", "function", "sentence"), FORMS.values(), ids=FORMS)
def test_a_method_that_returns_another_form_is_named(kind, method, function, sentence):
    mine = struct.dataclass(type("Mine", (kind,), {method: function}))
    numbers = {"youngs_modulus": 1e4, "poissons_ratio": 0.3}
    laws = (
        {"elasticity": mine(**numbers)} if kind is Hencky else {"elasticity": Hencky(**numbers), "plasticity": mine()}
    )
    with pytest.raises(ValueError, match="^" + re.escape(sentence)) as error:
        respond(Material(density=1e3, **laws), cp.split_matrix(jnp.eye(3)[None]))
    assert "\n" not in str(error.value) and ": return " in str(error.value)
