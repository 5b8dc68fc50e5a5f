"""Numbers that cannot be are refused when a scene is built, with field, value, legal range and remedy."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flat_materials import flat_material

from rewax.physics import coupling, mpm, rigid, tets
from rewax.physics.contact import Collider, Ground, PenaltyContact
from rewax.physics.coupling import Inertia, free_body
from rewax.physics.mpm import DruckerPrager, Grid, QuadraticFluid, Tait, VonMises, Wall, WallKind, Walls
from rewax.physics.shapes import Box, Capsule, Cylinder, Ellipsoid, HeightField, Sphere
from rewax.physics.tets import tetmesh

nan, inf = float("nan"), float("inf")
SOLID = {"youngs_modulus": 1e4, "poissons_ratio": 0.3, "density": 1000.0}
WATER = {"speed_of_sound": 5.0, "density": 1000.0, "elasticity": Tait}
SAND = {**SOLID, "plasticity": DruckerPrager, "friction_angle": 0.5}
OPEN = (None, None, None)
GRID = Grid(shape=(8, 9, 10), spacing=0.1, origin=(0.0, -0.2, 0.0))


def scene(material=SOLID, **changes) -> mpm.MPMScene:
    material = flat_material(**material) if isinstance(material, dict) else material
    return mpm.make_scene(**{"grid": GRID, "dt": 1e-4, "material": material, "particle_volume": 1e-4, **changes})


def collider(shape=None, **changes) -> dict:
    shape = Sphere(radius=0.1) if shape is None else shape
    return {"colliders": (Collider(**{"shape": shape, "friction": 0.5, **changes}),)}


def floor(**wall) -> dict:
    return {"walls": Walls(lower=(None, Wall(**wall), None), upper=OPEN)}


def ceiling(position: float) -> dict:
    return {"walls": Walls(lower=OPEN, upper=(None, Wall(position=position), None))}


IMPOSSIBLE = {
    "friction of a collider": (collider(friction=-0.1), "colliders[0].friction is -0.1, but must be 0 or more: give"),
    "friction NaN": (collider(friction=nan), "colliders[0].friction is nan, but must be 0 or more and finite: give"),
    "softness": (collider(softness=0.0), "colliders[0].softness is 0.0, but must be positive: give a decay per metre"),
    "softness NaN": (collider(softness=nan), "colliders[0].softness is nan, but must be positive and finite: give"),
    "offset": (collider(offset=np.array([0, nan, 0])), "colliders[0].offset[1] is nan, but must be finite: give"),
    "offset's shape": (collider(offset=np.zeros(2)), "colliders[0].offset has shape (2,): give an array of shape (3,)"),
    "rotation": (collider(rotation=np.full((3, 3), nan)), "colliders[0].rotation[0, 0] is nan, but must be finite"),
    "ball": (collider(Sphere(radius=0.0)), "colliders[0].shape.radius is 0.0, but must be positive: give a length"),
    "capsule": (collider(Capsule(radius=nan, half_length=1.0)), "colliders[0].shape.radius is nan, but must be"),
    "cylinder": (collider(Cylinder(radius=1.0, half_length=-1.0)), "colliders[0].shape.half_length is -1.0, but"),
    "box": (
        collider(Box(half_size=np.array([1, 2, 0]))),
        "colliders[0].shape.half_size[2] is 0.0, but must be positive",
    ),
    "box of two": (collider(Box(half_size=(1, 2))), "colliders[0].shape.half_size has shape (2,): give an array of"),
    "ellipsoid": (collider(Ellipsoid(semi_axes=np.array([1, nan, 1]))), "colliders[0].shape.semi_axes[1] is nan, but"),
    "terrain": (
        collider(HeightField(heights=np.zeros((2, 2)), origin=np.zeros(2), spacing=0.0)),
        "colliders[0].shape.spacing is 0.0, but must be positive",
    ),
    "no collider": ({"colliders": (Sphere(radius=0.1),)}, "colliders[0] is Sphere(radius="),
    "friction of a wall": (
        floor(position=0.1, friction=-0.2),
        "walls.lower[1].friction is -0.2, but must be 0 or more",
    ),
    "friction of no use": (
        floor(position=0.1, friction=0.2, kind=WallKind.SLIP),
        "walls.lower[1].friction is 0.2, but a wall of WallKind.SLIP has none: leave it out, or give WallKind.SEPARATING",
    ),
    "wall below": (floor(position=-0.2), "walls.lower[1].position is -0.2 m, but the nodes lie from -0.2 to 0.6 m"),
    "wall far below": (floor(position=-3.0), "walls.lower[1].position is -3 m, but the nodes lie from -0.2 to 0.6 m"),
    "wall above all": (floor(position=0.7), "walls.lower[1].position is 0.7 m, but the nodes lie from -0.2 to 0.6 m"),
    "ceiling above": (ceiling(0.6), "walls.upper[1].position is 0.6 m, but the nodes lie from -0.2 to 0.6 m along"),
    "gravity": ({"gravity": (0.0, nan, 0.0)}, "gravity[1] is nan, but must be finite: give an acceleration in m/s^2"),
    "gravity infinite": ({"gravity": (0.0, -inf, 0.0)}, "gravity[1] is -inf, but must be finite: give"),
    "gravity's shape": ({"gravity": 9.81}, "gravity has shape (): give an array of shape (3,)"),
    "volume NaN": (
        {"particle_volume": nan},
        "particle_volume is nan, but must be positive and finite: give the body's",
    ),
    "one volume": (
        {"particle_volume": np.array([1.0, -1.0])},
        "particle_volume[1] is -1.0, but must be positive: give",
    ),
    "density NaN": ({"material": {**SOLID, "density": nan}}, "density is nan, but must be positive and finite: give"),
    "density infinite": ({"material": {**SOLID, "density": inf}}, "density is inf, but must be positive and finite"),
    "no pressure": (
        {"material": {**SOLID, "elasticity": QuadraticFluid, "poissons_ratio": 0.0}},
        "elasticity.poissons_ratio is 0.0, but must be above 0 and below 0.5: take 0.3",
    ),
    "cohesion": (
        {"material": {**SAND, "cohesion": -0.01}},
        "plasticity.cohesion is -0.01, but must be 0 or more: give the largest tensile strain",
    ),
    "no yield stress": (
        {"material": {**SOLID, "plasticity": VonMises, "yield_stress": inf}},
        "plasticity.yield_stress is inf, but must be positive and finite: give the norm of the stress deviator at yield in Pa",
    ),
    "material's name": (
        {"material": (flat_material(**SOLID), flat_material(**{**WATER, "density": 0.0})), "particle_counts": (1, 1)},
        "material[1].density is 0.0, but must be positive",
    ),
}


@pytest.mark.parametrize(("changes", "sentence"), IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_mpm_scenes_refuse_impossible_numbers(changes, sentence):
    scene()
    with pytest.raises(ValueError, match="^" + re.escape(sentence)) as error:
        scene(**changes)
    assert "\n" not in str(error.value) and ": " in str(error.value)


def test_positions_must_be_finite_points():
    x = np.full((4, 3), 0.3)
    with pytest.raises(ValueError, match=r"x\[2, 1\] is nan, but must be finite: give positions in metres"):
        mpm.initial_state(np.where(np.arange(12).reshape(4, 3) == 7, nan, x))
    with pytest.raises(ValueError, match=r"x has shape \(3,\): give an array of shape \(num_particles, 3\)"):
        mpm.initial_state(x[0])
    with pytest.raises(ValueError, match=r"x\[0, 0\] is inf, but must be finite: give positions in metres"):
        tets.initial_state(x * inf)
    with pytest.raises(ValueError, match=r"x has shape \(3,\): give an array of shape \(num_vertices, 3\)"):
        tets.initial_state(x[0])
    with pytest.raises(
        ValueError, match=r"position\[0, 2\] is nan, but must be finite: give centres of mass in metres"
    ):
        free_body.bodies_at_rest([[0.0, 0.0, nan]])


# --- Words in the place of numbers ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: Wall(position=0.1, kind="slip"), "Wall.kind is 'slip': give one of WallKind.STICKY, WallKind.SLIP, Wall"),
        (lambda: scene(overlap="nearest"), "overlap is 'nearest': give one of Overlap.SEQUENTIAL, Overlap.NEAREST"),
        (lambda: scene().replace(overlap="nearest"), "overlap is 'nearest': give one of Overlap.SEQUENTIAL, Overlap.NEA"),
        (lambda: body(damping_law="strain rate"), "damping_law is 'strain rate': give one of DampingLaw.VELOCITY_GRADIEN"),
        (lambda: scene(dt="fast"), "dt is 'fast', which is no real number: give the duration of a substep in seconds"),
        (lambda: scene(dt=[1e-4, 1e-4]), "dt has shape (2,): give one number"),
        (lambda: jax.jit(lambda dt: scene(dt=dt).gravity)(1e-4), "dt is traced, but is part of the compiled program"),
        (lambda: body(dt="fast"), "dt is 'fast', which is no real number: give the duration of a substep in seconds"),
        (lambda: rigid.load(BALL, dt="fast"), "dt is 'fast', which is no real number: give the duration of a substep"),
        (lambda: rigid.load(BALL, dt=-1.0), "dt is -1.0, but must be positive: give the duration of a substep in seconds"),
        (lambda: Grid(shape=(9, 9, 9), spacing="x"), "Grid.spacing is 'x', which is no real number: give a distance in"),
        (lambda: Grid(shape=(9, 9, 9), spacing=0.0), "Grid.spacing is 0.0, but must be positive: give a distance in metre"),
        (lambda: Grid(shape=(9, 9), spacing=0.1), "Grid.shape is (9, 9): give three numbers of nodes, each at least 4"),
        (lambda: Grid(shape=(9, 9, 3), spacing=0.1), "Grid.shape[2] is 3: give three numbers of nodes, each at least 4"),
        (lambda: Grid(shape=(9, 9, 9.5), spacing=0.1), "Grid.shape[2] is 9.5: give three numbers of nodes, each at least 4"),
        (lambda: Grid(shape=(9, 9, 9), spacing=0.1, origin=(0, nan, 0)), "Grid.origin[1] is nan, but must be finite: give"),
        (lambda: Wall(position="low"), "Wall.position is 'low', which is no real number: give the wall's coordinate in"),
        (lambda: Wall(position=nan), "Wall.position is nan, but must be finite: give the wall's coordinate in metres"),
        (lambda: scene({**SOLID, "density": "heavy"}), "density is 'heavy', which is no real number: give the rest dens"),
        (lambda: scene({**SOLID, "density": None}), "density is None, but must be positive: give the rest density"),
        (lambda: scene({**SOLID, "density": [[1.0], [2.0, 3.0]]}), "density is [[1.0], [2.0, 3.0]], which is no real numb"),
        (lambda: scene("dough"), "material is 'dough': give a Material(density=..., elasticity=...)"),
        (lambda: scene(max_active_nodes="all"), "max_active_nodes is 'all': give at least the 27 that one particle"),
        (lambda: scene(max_near_colliders=1.5), "max_near_colliders is 1.5: give at least 1, or None for all"),
        (lambda: scene(gravity="down"), "gravity is 'down', which is no real number: give an acceleration in m/s^2"),
        (lambda: body(mu="soft"), "mu is 'soft', which is no real number: give the law's shear parameter in Pa"),
    ],
)  # fmt: skip
def test_what_is_no_number_or_member_is_refused(build, sentence):
    with pytest.raises(ValueError, match="^" + re.escape(sentence)) as error:
        build()
    assert "\n" not in str(error.value)


def test_a_grid_of_lists_and_arrays_is_the_grid_of_tuples():
    want = Grid(shape=(20, 9, 15), spacing=0.5, origin=(1.0, 2.0, 3.0))
    for make in (list, np.array, jnp.array):
        grid = Grid(shape=make([20, 9, 15]), spacing=np.float64(0.5), origin=make([1.0, 2.0, 3.0]))
        assert grid == want and hash(grid) == hash(want) and grid.num_nodes == 2700


# --- Tetrahedra, rigid bodies, coupling -------------------------------------------------------------------------------


MESH = tetmesh.box((0.2, 0.2, 0.2), (1, 1, 1))
CONTACT = PenaltyContact(stiffness=1e3, damping=1.0, friction_damping=1.0, friction=0.5)
FLOOR = Ground(normal=np.array([0.0, 1.0, 0.0]))
BALL = '<mujoco><worldbody><body><freejoint/><geom size="0.1" mass="1"/></body></worldbody></mujoco>'


def body(**changes) -> tets.TetScene:
    return tets.make_scene(**{"mesh": MESH, "density": 1000.0, "mu": 4e4, "lam": 6e4, "dt": 1e-4, **changes})


def test_coupled_bodies_refuse_impossible_numbers():
    with pytest.raises(ValueError, match=r"shape.radius is 0\.0, but must be positive"):
        free_body.inertia_of((Sphere(radius=0.0),), 500.0)
    with pytest.raises(ValueError, match=r"density is nan, but must be positive and finite"):
        free_body.inertia_of((Sphere(radius=0.1),), nan)
    bodies, state = free_body.bodies_at_rest([[0.3, 0.3, 0.3]]), mpm.initial_state(np.full((1, 3), 0.3))
    for inertia, sentence in (
        (Inertia(mass=np.array([-1.0]), moment=np.eye(3)[None]), r"inertia.mass\[0\] is -1.0, but must be positive"),
        (
            Inertia(mass=np.ones(1), moment=-np.eye(3)[None]),
            r"the diagonal of inertia.moment\[0, 0\] is -1.0, but must",
        ),
    ):
        with pytest.raises(ValueError, match=sentence):
            coupling.step(scene(**collider()), inertia, state, bodies, mpm.static_poses(2))
