"""The check of laws finds what is wrong with one, and says so."""

import re

import jax
import jax.numpy as jnp
import pytest
from material_cases import LAWS, material

from rewax import struct
from rewax.physics.mpm import Hencky, Material, Newtonian, Plasticity, Tait, VonMises
from rewax.physics.mpm.laws import Flow, LameParameters, Stretches, elongation_of
from rewax.physics.numerics import components as cp
from rewax.physics.numerics import divided_differences as dd
from rewax.physics.numerics.checks import POSITIVE
from rewax.testing import check_law, law
from rewax.types import Scalar

NUMBERS = {"youngs_modulus": 1e4, "poissons_ratio": 0.3}
QUIET = {"notify": None}


@struct.dataclass
class OneAxis(Hencky):
    """Stiffer along the first axis."""

    def principal_stress(self, s):
        tau = super().principal_stress(s)
        return struct_replace(tau, (2.0 * tau.values[0], *tau.values[1:]))


def struct_replace(p, values):
    return type(p)(values, p.differences)


@struct.dataclass
class WrongEnergy(Hencky):
    def energy(self, s):
        return 1.1 * super().energy(s)


@struct.dataclass
class WrongModuli(Hencky):
    def moduli(self):
        mu, lam = super().moduli()
        return LameParameters(2.0 * mu, lam)

    def principal_stress(self, s):
        return Hencky(youngs_modulus=self.youngs_modulus, poissons_ratio=self.poissons_ratio).principal_stress(s)

    def energy(self, s):
        return Hencky(youngs_modulus=self.youngs_modulus, poissons_ratio=self.poissons_ratio).energy(s)


@struct.dataclass
class Prestressed(Hencky):
    def principal_stress(self, s):
        return super().principal_stress(s) + 100.0


@struct.dataclass
class Cut(Hencky):
    """Its modulus gets no derivative."""

    def moduli(self):
        return jax.lax.stop_gradient(super().moduli())


@struct.dataclass
class SoundTooSlow(Tait):
    def sound_speed(self, density):
        return 0.1 * super().sound_speed(density)

    def stress(self, J, density):
        return Tait(speed_of_sound=self.speed_of_sound).stress(J, density)


@struct.dataclass
class Creeps(Plasticity):
    """Nothing flows, but it says so by a ratio that is 1 up to rounding."""

    limit: Scalar = struct.number(POSITIVE, "give a strain")

    def flow(self, s, moduli, memory):
        return Flow(s, (s.values * 3.0) / (s.values * 3.0000000000000004) - 1.0, memory)


@struct.dataclass
class Half(Plasticity):
    """Half of the strain flows; the elongation is a difference of logarithms."""

    limit: Scalar = struct.number(POSITIVE, "give a strain")

    def flow(self, s, moduli, memory):
        new = Stretches.of(dd.sqrt(dd.maximum(s.values, 1e-5)))
        return Flow(new, new.log - s.log, memory)


@struct.dataclass
class Runaway(VonMises):
    """Beyond yield the deviator grows."""

    def flow(self, s, moduli, memory):
        right = super().flow(s, moduli, memory)
        new = Stretches.of(dd.exp(s.log + (-0.5) * (right.stretches.log - s.log)))
        return Flow(new, elongation_of(s.values, new.values), right.memory)


@struct.dataclass
class Tilted(Newtonian):
    """It resists along the world's y axis alone."""

    def stress(self, F, velocity_gradient):
        C, zero = velocity_gradient, 0.0 * velocity_gradient[0][0]
        return cp.matrix(lambda i, j: self.viscosity * C[1][1] if i == j == 1 else zero)


@struct.dataclass
class Stiffens(Plasticity):
    initial_memory = (0.0,)
    rate: Scalar = struct.number(POSITIVE, "give a number")

    def flow(self, s, moduli, memory):
        return Flow(s, 0.0 * s.values, (jnp.maximum(memory[0], cp.norm(s.log.values)),))

    def stiffness(self, memory):
        return 1.0 + self.rate * memory[0]


@struct.dataclass
class Undefined(Stiffens):
    """Its stiffness is NaN beyond a stretch that small deformations do not reach."""

    def stiffness(self, memory):
        return jnp.where(memory[0] > 0.25, jnp.nan, 1.0)


@struct.dataclass
class Ages(Plasticity):
    """Remembers how many substeps it has seen."""

    initial_memory = (0.0,)
    rate: Scalar = struct.number(POSITIVE, "give a number")

    def flow(self, s, moduli, memory):
        return Flow(s, 0.0 * s.values, (memory[0] + self.rate,))


@struct.dataclass
class Engine(Newtonian):
    def stress(self, F, velocity_gradient):
        return [[-1.0 * a for a in row] for row in super().stress(F, velocity_gradient)]


@struct.dataclass
class Spinning(Newtonian):
    def stress(self, F, velocity_gradient):
        return cp.matrix(lambda i, j: self.viscosity * velocity_gradient[i][j])


@struct.dataclass
class Logarithm(Hencky):
    """Its energy ends at a stretch of two."""

    def energy(self, s):
        return super().energy(s) + 0.0 * jnp.log(2.0 - s.values.values[0])


SOLID = {"density": 1e3, "elasticity": Hencky(**NUMBERS)}


@pytest.mark.parametrize(
    ("material", "sentence"),
    [
        (Material(**SOLID, plasticity=Half(limit=0.1)), "the deformation after flow is not that of the stretches aft"),
        (Material(**SOLID, plasticity=Stiffens(rate=5.0)), "stiffness reaches "),
        (Material(**SOLID, plasticity=Undefined(rate=5.0)), "stiffness reaches nan"),
        (Material(**SOLID, plasticity=Ages(rate=0.01)), "memory changes in a body at rest"),
        (Material(**SOLID, plasticity=Runaway(yield_stress=10.0)), "flow raises the elastic energy"),
        (Material(**SOLID, viscosity=Tilted(viscosity=1.0)), "viscous stress does not turn with the body"),
        (Material(**SOLID, viscosity=Engine(viscosity=1.0)), "viscous stress makes energy"),
        (Material(**SOLID, viscosity=Spinning(viscosity=1.0)), "viscous stress is not symmetric"),
        (Material(density=1e3, elasticity=OneAxis(**NUMBERS)), "elastic stress "),
        (Material(density=1e3, elasticity=WrongEnergy(**NUMBERS)), "stress is not the derivative of energy by def"),
        (Material(density=1e3, elasticity=WrongModuli(**NUMBERS)), "stress of small strains is not Hooke's with modu"),
        (Material(density=1e3, elasticity=Prestressed(**NUMBERS)), "stress at rest is not zero"),
        (Material(density=1e3, elasticity=SoundTooSlow(speed_of_sound=5.0)), "stress of small strains is not Hooke's"),
        (Material(density=1e3, elasticity=Hencky(**NUMBERS), plasticity=Creeps(limit=0.1)), "what does not flow chan"),
        (Material(density=1e3, elasticity=Cut(**NUMBERS)), "the derivative by elasticity.youngs_modulus is 0"),
    ],
    ids=lambda m: "".join(type(law).__name__ for law in m.laws.values()) if isinstance(m, Material) else "",
)
def test_what_is_wrong_is_named(material, sentence):
    with pytest.raises(AssertionError, match="^" + re.escape(sentence)) as error:
        check_law(material, **QUIET)
    assert ": " in str(error.value) and "\n" not in str(error.value)


def test_an_energy_that_is_not_finite_is_named(monkeypatch):
    monkeypatch.setattr(law, "check_derivatives", lambda *args: None)  # takes long, and finds nothing wrong here
    with pytest.raises(AssertionError, match=r"^the energy of stretches 2\.0 is not finite: [^\n]*$"):
        check_law(Material(density=1e3, elasticity=Logarithm(**NUMBERS)), **QUIET)


def test_impossible_numbers_are_refused_first():
    with pytest.raises(ValueError, match=r"plasticity\.yield_stress is -1\.0"):
        check_law(Material(density=1e3, elasticity=Hencky(**NUMBERS), plasticity=VonMises(yield_stress=-1.0)))


def test_dough_that_flows_like_honey_passes(capsys):
    law = {"plasticity": VonMises(yield_stress=300.0), "viscosity": Newtonian(viscosity=1.0)}
    check_law(Material(density=1e3, elasticity=Hencky(**NUMBERS), **law))
    assert capsys.readouterr().out.endswith("passed\n")


@pytest.mark.slow
@pytest.mark.parametrize(("elasticity", "plasticity"), LAWS)
def test_laws_of_rewax_pass(elasticity, plasticity):
    check_law(jax.tree.map(lambda a: jnp.float32(a), material(elasticity, plasticity, dtype=jnp.float32)), **QUIET)
