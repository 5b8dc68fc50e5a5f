"""Is the physics right? Simulations compared with theory and experiments.

    python -m benchmarks.validation                                    # every case, minutes
    python -m benchmarks.validation cantilever incline --scale small   # these, seconds

Each case is a module with ``run(scale)``, which returns curves and ``"checks"``: what was measured, what theory says,
the error and the largest error that passes; and with ``plot(results, path)``.
"""

from types import ModuleType

from benchmarks.validation import (
    archimedes,
    cantilever,
    cantilever_fem,
    convergence,
    dam_break,
    free_flight,
    hydrostatic,
    identification,
    incline,
    sand_column,
    thin_bending,
    thin_catenary,
    thin_contact,
    thin_motion,
    wave_speed,
    yielding_bar,
)
from benchmarks.validation.common import Check

CASES: dict[str, ModuleType] = {
    "free_flight": free_flight,
    "wave_speed": wave_speed,
    "convergence": convergence,
    "cantilever": cantilever,
    "cantilever_fem": cantilever_fem,
    "yielding_bar": yielding_bar,
    "incline": incline,
    "hydrostatic": hydrostatic,
    "archimedes": archimedes,
    "dam_break": dam_break,
    "sand_column": sand_column,
    "identification": identification,
    "thin_catenary": thin_catenary,
    "thin_bending": thin_bending,
    "thin_motion": thin_motion,
    "thin_contact": thin_contact,
}

__all__ = ["CASES", "Check"]
