"""Wrong arguments of scenes, walls, colliders, shapes, tetrahedra and coupling: one sentence names field and remedy."""

import re

import jax
import numpy as np
import pytest

from rewax.physics import coupling, mpm, shapes, tets
from rewax.physics.contact import Collider, Ground, PenaltyContact, drawings, with_softness
from rewax.physics.coupling import Inertia, bodies_at_rest, inertia_of, solid
from rewax.physics.mpm import DruckerPrager, Grid, Hencky, Material, Newtonian, Wall, Walls
from rewax.physics.numerics.pose import Pose
from rewax.physics.shapes import Box, Capsule, HeightField, SampledDistance, Sphere
from rewax.physics.tets import TetMesh, tetmesh

GRID = Grid(shape=(8, 8, 8), spacing=0.1)
OPEN = (None, None, None)
SOLID = Material(density=1e3, elasticity=Hencky(youngs_modulus=1e4, poissons_ratio=0.3))
MESH = tetmesh.box((0.2, 0.2, 0.2), (1, 1, 1))
CONTACT = PenaltyContact(stiffness=1e3, friction_damping=1.0)
BALL, KEY = Sphere(radius=0.1), jax.random.key(0)
X = np.full((4, 3), 0.3)
NO_BODIES = Pose(np.zeros((0, 3)), np.zeros((0, 3, 3)))
WITHOUT_A_POSE = "collider 0 belongs to body 0, but there are poses of 0 bodies: give poses to all bodies"
OTHER = tets.initial_state(X)
OF_ANOTHER_MESH = (
    "state.x has shape (4, 3), but the scene has 8 vertices: give shape (8, 3) (map batches with jax.vmap)"
)
BATCH = jax.tree.map(lambda a: np.stack([a, a]), mpm.initial_state(X))
OF_A_BATCH = "state.x has shape (2, 4, 3): give shape (num_particles, 3) (map batches with jax.vmap)"


def scene(**changes):
    return mpm.make_scene(**{"grid": GRID, "dt": 1e-4, "material": SOLID, "particle_volume": 1e-4, **changes})


def material(**laws):
    return scene(material=SOLID.replace(**laws))


def collider(shape=BALL, **changes):
    return scene(colliders=(Collider(**{"shape": shape, "friction": 0.5, **changes}),))


def body(**changes):
    return tets.make_scene(**{"mesh": MESH, "density": 1e3, "mu": 4e4, "lam": 6e4, "dt": 1e-4, **changes})


def step(**changes):
    given = {"scene": scene(), "state": mpm.initial_state(X), "poses": mpm.static_poses(2), **changes}
    return mpm.step(**given)


def coupled(**changes):
    given = {
        "scene": scene(), "inertia": Inertia(mass=np.ones(1), moment=np.eye(3)[None]), "state": mpm.initial_state(X),
        "bodies": bodies_at_rest([[0.3, 0.3, 0.3]]), "poses": mpm.static_poses(2),
    }  # fmt: skip
    return coupling.step(**{**given, **changes})


NAN = float("nan")
TABLE = [
    # The grid, walls and the scene
    (lambda: Grid(shape=(8, 8, 8), spacing=True), "Grid.spacing is True, which is no real number: give a distance"),
    (lambda: Grid(shape=[[8], [8, 8], 8], spacing=0.1), "Grid.shape[0] is [8]: give three numbers of nodes"),
    (
        lambda: Grid(shape=(8, 8, 8), spacing=0.1, origin=np.eye(3)),
        "Grid.origin is an array of float64 of shape (3, 3)",
    ),
    (lambda: Wall(position=True), "Wall.position is True, which is no real number: give the wall's coordinate"),
    (lambda: Walls(lower=(0.1, None, None), upper=OPEN), "Walls.lower[0] is 0.1: give a Wall(position=...), or None"),
    (lambda: Walls(lower=OPEN, upper=None), "Walls.upper is None: give three walls along x, y and z"),
    (lambda: Walls(lower=(None, None), upper=OPEN), "Walls.lower is (None, None): give three walls along x, y and z"),
    (lambda: Walls(lower=(), upper=OPEN), "Walls.lower is (): give three walls along x, y and z"),
    (lambda: Walls(lower="floor", upper=OPEN), "Walls.lower is 'floor': give three walls along x, y and z"),
    (
        lambda: scene(walls=Walls(lower=(None, Wall(position=0.15, friction=[0.1, 0.2]), None), upper=OPEN)),
        "walls.lower[1].friction has shape (2,): give one number",
    ),
    (lambda: scene(grid=None), "grid is None: give a Grid(shape=..., spacing=...)"),
    (lambda: scene(grid=(8, 8, 8)), "grid is (8, 8, 8): give a Grid(shape=..., spacing=...)"),
    (lambda: scene(walls=None), "walls is None: give Walls(lower=..., upper=...)"),
    (lambda: scene(walls=[]), "walls is []: give Walls(lower=..., upper=...)"),
    (lambda: scene(colliders=None), "colliders is None: give a tuple of colliders, () for none"),
    (lambda: scene(colliders=Collider(shape=BALL, friction=0.5)), "colliders is Collider(shape=Sphere(radius="),
    (lambda: scene(colliders={}), "colliders is {}: give a tuple of colliders"),
    (lambda: scene(dt=True), "dt is True, which is no real number: give the duration of a substep in seconds"),
    (lambda: scene(reach=np.ones(3)), "reach is array([1., 1., 1.]): give 0.5 or 1.0"),
    (lambda: scene(reach=True), "reach is True: give 0.5 or 1.0"),
    (lambda: scene(max_near_colliders=True), "max_near_colliders is True: give at least 1, or None for all"),
    (
        lambda: scene(max_active_nodes=10**30),
        "max_active_nodes is 1000000000000000000000000000000: give at least the 27",
    ),
    (lambda: scene(particle_volume=[]), "particle_volume is [], which is no real number: give the body's rest volume"),
    (lambda: scene(particle_volume=np.ones(0)), "particle_volume has shape (0,): give shape (), or one entry for each"),
    (
        lambda: scene(gravity=np.array([False, True, False])),
        "gravity is array([False, True, False]), which is no real",
    ),
    (
        lambda: scene(material=(SOLID, SOLID), particle_counts=(True, 2)),
        "particle_counts[0] is True: give the number of",
    ),
    (
        lambda: scene(material=("dough", SOLID), particle_counts=(1, 2)),
        "material[0] is 'dough': give a Material(density",
    ),
    # Materials and laws
    (
        lambda: material(viscosity=Newtonian(viscosity=[])),
        "viscosity.viscosity is [], which is no real number: give the",
    ),
    (lambda: material(density=[]), "density is [], which is no real number: give the rest density in kg/m^3"),
    (lambda: material(density=True), "density is True, which is no real number: give the rest density in kg/m^3"),
    (
        lambda: material(viscosity=10**30),
        "viscosity is 1000000000000000000000000000000: give a law, viscosity=Newtonian",
    ),
    (lambda: material(plasticity=DruckerPrager(friction_angle=True)), "plasticity.friction_angle is True, which is no"),
    (lambda: mpm.largest_stable_dt(None, GRID), "material is None: give a Material(density=..., elasticity=...)"),
    (lambda: mpm.largest_stable_dt(SOLID, GRID, -1.0), "max_speed is -1.0, but must be 0 or more: give a speed in m/s"),
    # Colliders and shapes
    (
        lambda: Collider(shape=BALL, friction=0.5, body=-1),
        "Collider.body is -1: give the index of a body, counted from 0",
    ),
    (lambda: Collider(shape=BALL, friction=0.5, body="hand"), "Collider.body is 'hand': give the index of a body"),
    (lambda: collider(friction=[0.1, 0.2]), "colliders[0].friction has shape (2,): give one number"),
    (lambda: collider(softness=[]), "colliders[0].softness is [], which is no real number: give a decay per metre"),
    (lambda: collider(rotation=np.ones((3, 3))), "colliders[0].rotation is [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 1"),
    (lambda: collider(rotation=-np.eye(3)), "colliders[0].rotation is [[-1.0, "),
    (lambda: collider(10**30), "colliders[0].shape is 1000000000000000000000000000000: give a shape of rewax.physics"),
    (lambda: collider(Sphere(radius=[0.1, 0.2])), "colliders[0].shape.radius has shape (2,): give one number"),
    (
        lambda: collider(Sphere(radius=True)),
        "colliders[0].shape.radius is True, which is no real number: give a length",
    ),
    (lambda: collider(Capsule(radius=0.1, half_length=[])), "colliders[0].shape.half_length is [], which is no real"),
    (
        lambda: collider(HeightField(heights=np.zeros(3), origin=(0, 0), spacing=0.1)),
        "colliders[0].shape.heights has shape (3,): give an array of shape (nx, nz)",
    ),
    (
        lambda: collider(SampledDistance(values=0.1, origin=(0, 0, 0), spacing=0.1)),
        "colliders[0].shape.values has shape (): give an array of shape (nx, ny, nz)",
    ),
    (lambda: with_softness(None, 0.1), "colliders is None: give a tuple of colliders"),
    (lambda: with_softness((), 0.0), "spacing is 0.0, but must be positive: give the grid's spacing in metres"),
    (lambda: drawings(collider().colliders, NO_BODIES), WITHOUT_A_POSE),
    (lambda: mpm.check_status(collider(), mpm.initial_state(X), poses=mpm.static_poses(2)), WITHOUT_A_POSE),
    (
        lambda: tets.contact_force(
            body(contact=CONTACT, colliders=collider().colliders), tets.initial_state(MESH.vertices), *[NO_BODIES] * 2
        ),
        WITHOUT_A_POSE,
    ),
    (lambda: drawings((), None), "bodies is None: give a Pose, static_poses(num_substeps) for no bodies"),
    (lambda: shapes.sample_box(0, (0, 0, 0), (1, 1, 1), 3), "key is 0: give a PRNG key, jax.random.key(0)"),
    (lambda: shapes.sample_box(KEY, (0, 0), (1, 1, 1), 3), "center has shape (2,): give an array of shape (3,)"),
    (
        lambda: shapes.sample_box(KEY, (0, 0, 0), (1, -1, 1), 3),
        "size[1] is -1, but must be 0 or more: give three edges",
    ),
    (lambda: shapes.sample_box(KEY, (0, 0, 0), (1, 1, 1), 2.5), "num is 2.5: give the number of points, at least 1"),
    (lambda: shapes.fill_box((0, 0, 0), (1, 1), 0.5), "size has shape (2,): give an array of shape (3,)"),
    (lambda: shapes.fill_box(None, (1, 1, 1), 0.5), "center is None, but must be finite: give a position in metres"),
    (lambda: shapes.fill_box((0, 0, 0), (1, 1, 1), "fine"), "spacing is 'fine', which is no real number: give the"),
    (lambda: shapes.fill(BALL, [0.1]), "spacing has shape (1,): give one number"),
    (lambda: shapes.fill(Sphere(radius=-1.0), 0.1), "shape.radius is -1.0, but must be positive: give a length in met"),
    (lambda: shapes.sample("seed", BALL, 3), "key is 'seed': give a PRNG key"),
    (lambda: shapes.sample(KEY, object, 3), "shape is <class 'object'>: give a shape of rewax.physics.shapes"),
    (lambda: shapes.sample(KEY, BALL, None), "num is None: give the number of points, at least 1"),
    (lambda: shapes.sample_poisson_disk(KEY, BALL, None), "radius is None, but must be positive: give the smallest"),
    (lambda: shapes.volume(Box(half_size=(1, 2))), "shape.half_size has shape (2,): give an array of shape (3,)"),
    (lambda: shapes.bounding_box(Sphere(radius=NAN)), "shape.radius is nan, but must be positive and finite: give a"),
    (lambda: shapes.signed_distance(BALL, "here"), "points is 'here': give points of shape (..., 3) in metres"),
    (
        lambda: shapes.bake_mesh("a.stl", "fine"),
        "spacing is 'fine', which is no real number: give the distance of grid",
    ),
    (
        lambda: shapes.check_mesh(TetMesh(MESH.vertices, np.zeros((1, 3), int))).faces,
        "mesh is TetMesh(vertices=array(",
    ),
    # Particles and steps
    (lambda: mpm.initial_state("here"), "x is 'here', which is no real number: give positions in metres"),
    (lambda: mpm.initial_state(None), "x is None, but must be finite: give positions in metres"),
    (
        lambda: mpm.initial_state([[0.1, 0.2], [0.3]]),
        "x is [[0.1, 0.2], [0.3]], which is no real number: give positions",
    ),
    (lambda: mpm.initial_state(X, "scene"), "scene is 'scene': give a scene of mpm.make_scene"),
    (lambda: step(scene=None), "scene is None: give a scene of mpm.make_scene"),
    (
        lambda: step(state=X),
        "state is an array of float64 of shape (4, 3): give a state of mpm.initial_state or mpm.step",
    ),
    (lambda: step(poses=3), "poses is 3: give a Pose, static_poses(num_substeps) for no bodies"),
    (
        lambda: step(poses=mpm.static_poses(2)._replace(rotation=np.eye(3))),
        "poses has positions of shape (3, 0, 3) and",
    ),
    (lambda: step(store_every="all"), "store_every is 'all': give an integer that divides the 2 substeps, or None"),
    (lambda: step(store_every=[1]), "store_every is [1]: give an integer that divides the 2 substeps, or None"),
    (lambda: mpm.check_status(scene(), None), "state is None: give a state of mpm.initial_state or mpm.step"),
    (lambda: mpm.check_status(scene(), mpm.initial_state(X), poses=1), "poses is 1: give a Pose, or None"),
    (lambda: mpm.check_placement(scene(), mpm.initial_state(X), tolerance="deep"), "tolerance is 'deep', which is no"),
    (lambda: step(state=BATCH), OF_A_BATCH),
    (lambda: mpm.substep(scene(), BATCH, NO_BODIES, NO_BODIES), OF_A_BATCH),
    (lambda: mpm.step_with_touch(scene(), BATCH, mpm.static_poses(2), {}), OF_A_BATCH),
    (lambda: mpm.check_status(scene(), BATCH), OF_A_BATCH),
    (lambda: mpm.deform(scene(), BATCH), OF_A_BATCH),
    (lambda: coupled(state=BATCH), OF_A_BATCH),
    (lambda: step(state=BATCH.replace(x=X, v=X)), "state.C has shape (2, 4, 3, 3): give shape (num_particles, 3, 3)"),
    (lambda: step(state=mpm.initial_state(X).replace(memory=X[:2])), "state.memory has shape (2, 3): give shape (num"),
    (lambda: step(scene=scene(particle_volume=[1e-4] * 3)), "particle_volume has 3 entries, but there are 4 particles"),
    (lambda: mpm.static_poses(-2), "num_substeps is -2: give the number of substeps"),
    (lambda: mpm.static_poses(2, 1.5), "num_bodies is 1.5: give the number of bodies"),
    (
        lambda: mpm.predict_peak_bytes(scene(), num_particles=-4, num_substeps=4),
        "num_particles is -4: give an integer of at least 1",
    ),
    (
        lambda: mpm.predict_peak_bytes(scene(), num_particles=4, num_substeps=4, bytes_per_float="double"),
        "bytes_per_float is 'double': give 4 or 8",
    ),
    # Tetrahedra
    (lambda: body(mesh=None), "mesh is None: give a TetMesh, of tetmesh.box or load_tetmesh for example"),
    (lambda: body(mesh=TetMesh([[0, 0, 0], [1, 0]], MESH.tets)), "vertices is [[0, 0, 0], [1, 0]], which is no real"),
    (
        lambda: body(held=[[0], [1, 2]]),
        "held is an array of object of shape (): give different indices of vertices, or a mask",
    ),
    (
        lambda: body(held=[[0, 1]]),
        "held is an array of int64 of shape (1, 2): give different indices of vertices, or a mask",
    ),
    (lambda: body(colliders=3), "colliders is 3: give a tuple of colliders, () for none"),
    (lambda: body(density=True), "density is True, which is no real number: give the rest density in kg/m^3"),
    (
        lambda: body(contact=CONTACT, ground=Ground(normal=[1.0])),
        "ground.normal has shape (1,): give an array of shape",
    ),
    (
        lambda: body(contact=CONTACT, ground=Ground(normal=(0, 1, 0), height=[0.0, 1.0])),
        "ground.height has shape (2,): give one number",
    ),
    (lambda: tets.initial_state(None), "x is None, but must be finite: give positions in metres"),
    (lambda: tets.step(body(), None, mpm.static_poses(2)), "state is None: give a state of tets.initial_state or tets"),
    (lambda: tets.step(body(), OTHER, mpm.static_poses(2)), OF_ANOTHER_MESH),
    (lambda: tets.substep(body(), OTHER, NO_BODIES, NO_BODIES), OF_ANOTHER_MESH),
    (lambda: tets.step_with_touch(body(), OTHER, mpm.static_poses(2), {}), OF_ANOTHER_MESH),
    (lambda: tets.internal_force(body(), OTHER), OF_ANOTHER_MESH),
    (lambda: tets.contact_force(body(), OTHER, NO_BODIES, NO_BODIES), OF_ANOTHER_MESH),
    (lambda: tets.elastic_energy(body(), OTHER), OF_ANOTHER_MESH),
    (lambda: tets.check_status(body(), OTHER), OF_ANOTHER_MESH),
    (lambda: tets.deformation_gradient(body(), OTHER.x), OF_ANOTHER_MESH.removeprefix("state.")),
    (lambda: coupled(scene=body(), state=OTHER), OF_ANOTHER_MESH),
    (lambda: tetmesh.box(1.0, (1, 1, 1)), "size has shape (): give an array of shape (3,)"),
    (lambda: tetmesh.box((1, 1, 1), 2), "counts is 2: give the numbers of cells along x, y and z, each at least 1"),
    (lambda: tetmesh.box((1, 1, 1), (1, 1, 1.5)), "counts[2] is 1.5: give the numbers of cells along x, y and z"),
    (lambda: tetmesh.box((1, 1, 1), (1, 1, 1), center=(0, 0)), "center has shape (2,): give an array of shape (3,)"),
    (lambda: tetmesh.voxels(True, 0.1), "occupied is True: give a mask of shape (nx, ny, nz)"),
    (
        lambda: tetmesh.voxels(np.full((1, 1, 1), 0.5), 0.1),
        "occupied is array([[[0.5]]]): give a mask of shape (nx, ny, nz)",
    ),
    (lambda: tetmesh.cells(np.ones((1, 1, 1), bool), 1.0), "lines is 1.0: give three arrays of coordinates in metres"),
    (
        lambda: tetmesh.split_edges(MESH, [0, 1]),
        "edges is [0, 1]: give pairs of vertices, integers of shape (num_edges",
    ),
    (lambda: tets.load_tetmesh(None), "path is None: give the path of a mesh file"),
    (lambda: tets.check_tetmesh(MESH, min_shape="flat"), "min_shape is 'flat', which is no real number: give a ratio"),
    (
        lambda: tets.stable_parameters(-1e4, 0.3),
        "youngs_modulus is -10000.0, but must be positive: give Young's modulus",
    ),
    (lambda: tets.stable_parameters(1e4, 0.5), "poissons_ratio is 0.5, but must be above -1 and below 0.5: take 0.45"),
    # Coupling
    (lambda: solid(BALL, [1.0, 2.0]), "density has shape (2,): give one number"),
    (lambda: inertia_of((), 1e3), "shapes is empty: give at least one shape"),
    (lambda: inertia_of(BALL, 1e3), "shapes is Sphere(radius="),
    (lambda: bodies_at_rest(None), "position is None, but must be finite: give centres of mass in metres"),
    (lambda: bodies_at_rest([[0, 0, 0]], [1, 0, 0, 0]), "orientation has shape (4,): give an array of shape (1, 4)"),
    (lambda: coupled(scene=None), "scene is None: give a scene of mpm.make_scene, tets.make_scene, thin.make_scene or"),
    (lambda: coupled(inertia=1.0), "inertia is 1.0: give an Inertia(mass=..., moment=...), of inertia_of for example"),
    (lambda: coupled(inertia=Inertia(mass=None, moment=np.eye(3)[None])), "inertia.mass is None, but must be positive"),
    (
        lambda: coupled(inertia=Inertia(mass=np.ones(1), moment=1.0)),
        "inertia.moment has shape (): give an array of shape",
    ),
    (lambda: coupled(bodies=None), "bodies is None: give FreeBodies, of bodies_at_rest for example"),
    (lambda: coupled(wrench=(0, 0)), "wrench is (0, 0): give a Wrench(force, torque), or None"),
    (lambda: coupling.no_wrench(-1), "num_bodies is -1: give the number of bodies"),
]


@pytest.mark.parametrize(("build", "sentence"), TABLE, ids=[sentence.partition(":")[0][:60] for _, sentence in TABLE])
def test_bad_inputs_get_one_sentence_that_names_them(build, sentence):
    with pytest.raises(ValueError, match="^" + re.escape(sentence)) as caught:
        build()
    text = str(caught.value)
    assert "\n" not in text and ": " in text and len(text) < 320


def test_good_inputs_of_the_table_are_accepted():
    assert step().x.shape == (4, 3) and coupled()[0].x.shape == (4, 3) and body().mass.shape == (8,)
    assert collider(rotation=np.eye(3)).colliders[0].body == 0
