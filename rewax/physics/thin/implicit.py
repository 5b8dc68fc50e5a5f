"""Settings of the implicit time step of cloth and ropes; ``implicit_step`` takes it."""

from dataclasses import dataclass

from rewax.physics.numerics.checks import POSITIVE
from rewax.physics.numerics.fields import check_fields, integer, static

_FIELDS = {
    "tolerance": static(POSITIVE, "give a speed in m/s"),
    "newton_iterations": integer(1, "give at least 1"),
    "cg_iterations": integer(1, "give at least 1"),
    "cg_tolerance": static(POSITIVE, "take 0.01"),
    "gradient_tolerance": static(POSITIVE, "take 1e-6"),
}


@dataclass(frozen=True, kw_only=True)
class Implicit:
    """Implicit Euler, solved by Newton's method with conjugate gradients. It has no largest stable dt.

    Attributes:
      tolerance: largest error of the velocities that a step may leave [m/s], as root of their mean square weighted
        with the masses. Larger errors set ``Status.UNSOLVED``.
      newton_iterations: largest number of Newton steps per time step.
      cg_iterations: largest number of products with the stiffness matrix per Newton step. Derivatives may take ten
        times as many; those that need more are NaN.
      cg_tolerance: relative residual at which conjugate gradients stop in a Newton step [-].
      gradient_tolerance: the same for derivatives [-]. Their error is larger by the conditioning of the linear system:
        at 1e-6 it is below 1e-4 of the gradient on a sheet with a Young's modulus of 10 MPa and steps of 5 ms, in
        double precision.

    Scenes with grasps and ``coupling`` refuse it.

    Gradient: that of a converged step, see ``thin.step``.
    Source: Gast et al. 2015, "Optimization integrator for large time steps".

    Raises:
      ValueError: a number is not positive, or a number of iterations is no integer.
    """

    tolerance: float = 1e-3
    newton_iterations: int = 20
    cg_iterations: int = 300
    cg_tolerance: float = 1e-2
    gradient_tolerance: float = 1e-6

    def __post_init__(self) -> None:
        check_fields(_FIELDS, vars(self), "stepper.")


__all__ = ["Implicit"]
