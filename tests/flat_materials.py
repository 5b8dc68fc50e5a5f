"""Materials from flat numbers, for tests that go through many laws: each law takes those that it has."""

import dataclasses

from rewax.physics.mpm import Elasticity, Hencky, Material, Muscle, Newtonian, Plasticity
from rewax.physics.mpm.materials import parameters_of


def flat_material(
    elasticity: type[Elasticity] = Hencky, plasticity: type[Plasticity] | None = None, **numbers
) -> Material:
    """A material of these laws. Numbers that none of them has, of ``viscosity``, ``fibre`` and so on, are left out."""

    def law(kind):
        names = {f.name for f in dataclasses.fields(kind)}
        return kind(**{name: value for name, value in numbers.items() if name in names})

    return Material(
        density=numbers.get("density", 1000.0),
        elasticity=law(elasticity),
        plasticity=None if plasticity is None else law(plasticity),
        viscosity=law(Newtonian) if "viscosity" in numbers else None,
        muscle=law(Muscle) if "fibre" in numbers else None,
    )


def flat_numbers(material: Material) -> dict[str, float]:
    """Numbers of a material and its laws by their names."""
    return {p.name: float(p.value) for p in parameters_of(material)}
