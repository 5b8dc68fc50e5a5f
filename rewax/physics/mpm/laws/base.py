"""Base classes of constitutive laws, and the functions through which ``materials`` evaluates them.

Every solid law needs only the left Cauchy-Green tensor b = F F^T = U diag(s^2) U^T. An elasticity maps principal
stretches s to principal Kirchhoff stresses tau; a plasticity maps trial stretches to admissible ones. So any elasticity
combines with any plasticity, and both share one spectral evaluation with an exact derivative (``linalg3``). A fluid
needs only J = det F. Viscous and active stresses are functions of F and the velocity gradient, and are added.

Principal values are ``Principal`` objects: values on each axis with their divided differences, which
``linalg3.spectral`` requires. ``+ - * /`` and the functions of ``divided_differences`` (``log``, ``exp``, ``maximum``,
...) act on them. A quantity that depends on all axes (``s.volume``, a trace, a norm) is one array.

A law is a ``struct.dataclass``. Its parameters are ``struct.number`` fields: numbers, or arrays with one entry per
particle.
"""

import math
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp

from rewax import struct
from rewax.lowering.fusion import materialize
from rewax.physics.numerics import components as cp
from rewax.physics.numerics import divided_differences as dd
from rewax.physics.numerics.checks import Number, numbers_of, shown
from rewax.physics.numerics.components import Mat3
from rewax.physics.numerics.divided_differences import Principal
from rewax.physics.numerics.elastic_constants import LameParameters
from rewax.types import Array, Scalar

MIN_STRETCH = 1e-5
"""Lower bound of stretches in logarithms and quotients [-]."""


class Stretches(NamedTuple):
    """Principal stretches of a particle."""

    values: Principal
    """s [-]: square roots of the eigenvalues of F F^T, the smallest with the sign of det F."""
    log: Principal
    """Logarithmic strain log s [-]; log ``MIN_STRETCH`` on inverted axes."""

    @property
    def volume(self) -> Array:
        """J = s_1 s_2 s_3 [-]."""
        return self.values.product

    def volume_to(self, power: float) -> Array:
        """J^power [-] from the logarithmic strains; finite for flattened and inverted particles."""
        return jnp.exp(power * self.log.sum)

    @classmethod
    def of(cls, values: Principal) -> "Stretches":
        """Stretches with these values and their logarithms."""
        return cls(values, dd.log(dd.maximum(values, MIN_STRETCH)))


class Law(struct.Replaceable):
    """Base of all laws."""

    def numbers(self, prefix: str = "") -> list[Number]:
        """The parameters with their legal values. Extend it by values that follow from several of them.

        Args:
          prefix: text before the parameters' names in messages.
        """
        return numbers_of(self, prefix)

    look: ClassVar[str | None] = None
    """How viewers draw particles: "water", "muscle", "dough", "sand", "snow", "elastic"; None: another law decides."""

    def _missing(self, method: str) -> NotImplementedError:
        return NotImplementedError(f"{type(self).__name__} has no {method}: define it, see docs/your_own_law.md")


class Elasticity(Law):
    """Stress as a function of principal stretches; also the base of ``Fluid``.

    Extend it by ``moduli``, ``principal_stress`` and ``energy``, which raise NotImplementedError here. Stretches and
    results have the shape of the particles. Gradients must be exact; ``divided_differences`` gives them.
    """

    def moduli(self) -> LameParameters:
        """Lame parameters at small strains [Pa]. Sound speed and plastic flow use them."""
        raise self._missing("moduli()")

    def principal_stress(self, s: Stretches) -> Principal:
        """Principal Kirchhoff stresses tau_i = s_i dpsi/ds_i [Pa]."""
        raise self._missing("principal_stress(s)")

    def energy(self, s: Stretches) -> Array:
        """Elastic energy per rest volume psi [J/m^3], 0 at s = 1."""
        raise self._missing("energy(s)")

    def sound_speed(self, density: Scalar) -> Scalar:
        """Speed of pressure waves at rest [m/s], for a rest density [kg/m^3]."""
        mu, lam = self.moduli()
        return jnp.sqrt((lam + 2.0 * mu) / density)


class Fluid(Elasticity):
    """An elasticity that depends on volume only: F is reset to J^(1/3) I in every substep.

    Extend it by ``stress``, ``energy_of_volume`` and ``sound_speed``, which raise NotImplementedError here.
    """

    look = "water"

    def stress(self, J: Array, density: Scalar) -> Array:
        """Kirchhoff stress on all axes [Pa] at the volume ratio J [-]: J dpsi/dJ, minus J times the pressure."""
        raise self._missing("stress(J, density)")

    def energy_of_volume(self, J: Array, density: Scalar) -> Array:
        """Elastic energy per rest volume psi [J/m^3], 0 at J = 1."""
        raise self._missing("energy_of_volume(J, density)")


class Flow(NamedTuple):
    """Result of a return map.

    Attributes:
      stretches: stretches after flow.
      elongation: new over trial stretch minus one [-]. It must be exactly zero where nothing flows: rounding would make
        volume creep.
      memory: history variables, one for each entry of ``Plasticity.initial_memory``.
    """

    stretches: Stretches
    elongation: Principal
    memory: tuple[Array, ...] = ()


class Plasticity(Law):
    """Return map onto a yield surface, with optional history variables.

    Extend it by ``flow``, and for history variables by ``initial_memory``, ``stiffness``, ``largest_stiffness`` and
    ``was_inverted``.
    ``LogarithmicPlasticity`` is simpler to extend.

    Attributes:
      initial_memory: initial values of the history variables that each particle carries in ``MPMState.memory``.
      largest_stiffness: upper bound of ``stiffness``, for the stable substep.
    """

    initial_memory: ClassVar[tuple[float, ...]] = ()
    largest_stiffness: ClassVar[float] = 1.0

    def flow(self, s: Stretches, moduli: LameParameters, memory: tuple[Array, ...]) -> Flow:
        """Admissible stretches, and the history variables after this substep.

        Args:
          s: trial stretches.
          moduli: moduli of the elasticity at small strains [Pa].
          memory: history variables, one array for each entry of ``initial_memory``.
        """
        raise self._missing("flow(s, moduli, memory)")

    def stiffness(self, memory: tuple[Array, ...]) -> Array | None:
        """Factor on elastic stress and energy [-]; None: 1."""
        del memory
        return None

    def was_inverted(self, memory: tuple[Array, ...]) -> Array:
        """Whether particles have been turned inside out, as far as the history variables tell, bool."""
        del memory
        return jnp.bool_(False)


class LogarithmicPlasticity(Plasticity):
    """A return map in logarithmic strains. Extend it by ``return_map``.

    Attributes:
      least_stretch: lower bound of trial stretches in the return map [-].
    """

    least_stretch: ClassVar[float] = 0.01

    def return_map(self, log_s: Principal, moduli: LameParameters) -> tuple[Principal, Array]:
        """Change of logarithmic strains by flow [-], and whether the particle flows, bool."""
        raise self._missing("return_map(log_s, moduli)")

    def flow(self, s: Stretches, moduli: LameParameters, memory: tuple[Array, ...]) -> Flow:
        at_least = dd.maximum(s.log, math.log(self.least_stretch))
        change, flows = self.return_map(at_least, moduli)
        floor = dd.maximum(s.values, self.least_stretch)
        # A particle that does not flow keeps its trial state, inverted or not.
        new = dd.select(flows, dd.multiply(floor, dd.exp(change)), s.values)
        log_new = dd.select(flows, dd.add(at_least, change), s.log)
        unchanged = dd.uniform(jnp.zeros_like(s.values.values[0]), s.values)
        elongation = dd.select(flows, elongation_of(s.values, floor, change), unchanged)
        return Flow(Stretches(new, log_new), elongation, memory)


class Viscosity(Law):
    """Stress as a function of the rate of deformation. Extend it by ``stress`` and ``dynamic_viscosity``."""

    def stress(self, F: Mat3, velocity_gradient: Mat3) -> Mat3:
        """Kirchhoff stress [Pa] for F [-] and the velocity gradient [1/s], by components."""
        raise self._missing("stress(F, velocity_gradient)")

    def dynamic_viscosity(self) -> Scalar:
        """Upper bound of the dynamic viscosity [Pa s], for the stable substep."""
        raise self._missing("dynamic_viscosity()")


class ActiveStress(Law):
    """Stress that a controller sets (a muscle). Extend it by ``stress``."""

    look = "muscle"

    def stress(self, F: Mat3) -> Mat3:
        """Kirchhoff stress [Pa] for F [-], by components."""
        raise self._missing("stress(F)")


def elongation_of(s: Principal, floor: Principal, change: Principal | None = None) -> Principal:
    """floor exp(change) / s - 1 [-]; exactly zero where floor equals s and the change of logarithmic strain is 0."""
    ratio = dd.multiply(floor, dd.reciprocal(s))
    more = cp.subtract(floor.values, s.values)
    if change is not None:
        ratio, growth = dd.multiply(ratio, dd.exp(change)), dd.expm1(change)
        more = cp.vector(lambda i: more[i] + floor.values[i] * growth.values[i])
    return Principal(cp.vector(lambda i: more[i] / s.values[i]), ratio.differences)


def stretches(eigenvalues: Principal, sign: Array) -> Principal:
    """Square roots of the eigenvalues of F F^T, the smallest with the sign of det F.

    If exactly two are the smallest, both have the sign, and the sign of J is lost. ``Status.INVERTED`` is set.
    """
    root = dd.sqrt(dd.maximum(eigenvalues, MIN_STRETCH**2))
    a, b, c = eigenvalues.values
    smallest = jnp.minimum(jnp.minimum(a, b), c)
    signs = cp.vector(lambda i: jnp.where(eigenvalues.values[i] == smallest, sign, 1.0))
    s = cp.vector(lambda i: signs[i] * root.values[i])
    if root.differences is None:
        return Principal(s)
    alike = root.differences

    def difference(i: int, j: int, k: int) -> Array:
        """For different signs and equal magnitudes the quotient is unbounded; there it is set to zero."""
        gap = eigenvalues.values[i] - eigenvalues.values[j]
        near = jnp.abs(gap) < jnp.finfo(gap.dtype).eps ** (1 / 3) * (root.values[i] + root.values[j]) ** 2
        differ = jnp.where(near, 0.0, (s[i] - s[j]) * dd.inverse_gap(eigenvalues.values, i, j))
        return jnp.where(signs[i] == signs[j], signs[i] * alike[k], differ)

    return Principal(s, cp.vector(lambda k: difference(*dd.PAIRS[k], k)))  # pyright: ignore[reportCallIssue]


# --- Functions for ``linalg3.spectral`` -------------------------------------------------------------------------------


class Parameters(NamedTuple):
    """Arguments of the laws of a solid."""

    elasticity: Elasticity
    plasticity: Plasticity | None
    sign: Array
    """Sign of det F."""
    memory: tuple[Array, ...] = ()


def elastic_law(eigenvalues: Principal, p: Parameters) -> tuple[Principal]:
    """Principal stresses."""
    return (_stress(p.elasticity, Stretches.of(stretches(eigenvalues, p.sign))),)


def plastic_law(eigenvalues: Principal, p: Parameters) -> tuple[Principal | Array, ...]:
    """Elongation by plastic flow, stress at the new stretches, history variables."""
    assert p.plasticity is not None
    s = stretches(eigenvalues, p.sign)
    log_s = dd.log(dd.maximum(s, MIN_STRETCH))
    flow = p.plasticity.flow(Stretches(s, materialize(log_s)), p.elasticity.moduli(), p.memory)
    _check_flow(p.plasticity, flow)
    flow = flow._replace(stretches=materialize(flow.stretches))
    stress = _stress(p.elasticity, flow.stretches)
    stiffness = p.plasticity.stiffness(flow.memory)
    return flow.elongation, stress if stiffness is None else dd.scale(stiffness, stress), *flow.memory


def energy_law(eigenvalues: Principal, p: Parameters) -> tuple[Array]:
    """Elastic energy per rest volume."""
    psi = p.elasticity.energy(Stretches.of(stretches(eigenvalues, p.sign)))
    stiffness = None if p.plasticity is None else p.plasticity.stiffness(p.memory)
    return (psi if stiffness is None else stiffness * psi,)


def _stress(elasticity: Elasticity, s: Stretches) -> Principal:
    """Principal stresses. Raises ValueError if the law returns something else."""
    stress = elasticity.principal_stress(s)
    if not isinstance(stress, Principal):
        raise ValueError(
            f"{type(elasticity).__name__}.principal_stress returned {shown(stress)}: return a Principal, computed from "
            "s.values and s.log with + - * / and divided_differences"
        )
    return stress


def _check_flow(plasticity: Plasticity, flow: Any) -> None:
    """Raises ValueError unless a return map gave a ``Flow`` with the memory of its law."""
    name = type(plasticity).__name__
    if not isinstance(flow, Flow):
        raise ValueError(f"{name}.flow returned {shown(flow)}: return Flow(stretches, elongation, memory)")
    for part, kind in (("stretches", Stretches), ("elongation", Principal), ("memory", (tuple, list))):
        if not isinstance(value := getattr(flow, part), kind):
            remedy = "a tuple of arrays" if part == "memory" else f"a {kind.__name__}"  # type: ignore[union-attr]
            raise ValueError(f"{name}.flow returned {part} {shown(value)}: return {remedy}")
    given, wanted = len(flow.memory), len(plasticity.initial_memory)
    if given != wanted:
        raise ValueError(
            f"{name}.flow returned {given} entries of memory, but initial_memory has {wanted}: return one for each"
        )
