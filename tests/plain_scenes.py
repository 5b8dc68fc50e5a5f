"""Materials of each kind and a scene of one of them, for tests of what is refused."""

from flat_materials import flat_material

from rewax.physics import mpm
from rewax.physics.mpm import DruckerPrager, Grid, Tait

nan, inf = float("nan"), float("inf")
SOLID = {"youngs_modulus": 1e4, "poissons_ratio": 0.3, "density": 1000.0}
WATER = {"speed_of_sound": 5.0, "density": 1000.0, "elasticity": Tait}
SAND = {**SOLID, "plasticity": DruckerPrager, "friction_angle": 0.5}


def scene(material, **changes) -> mpm.MPMScene:
    """A scene of a small grid. Arguments of ``mpm.make_scene`` that ``changes`` names take the place of its own."""
    material = flat_material(**material) if isinstance(material, dict) else material
    grid = Grid(shape=(8, 9, 10), spacing=0.1)
    return mpm.make_scene(**{"grid": grid, "dt": 1e-4, "material": material, "particle_volume": 1e-4, **changes})
