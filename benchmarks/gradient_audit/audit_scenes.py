"""The scenes of the audit: what every simulator is given, in SI units, as plain numbers.

Each scene maps a few parameters to one number, the outcome. Starts are drawn once, from a fixed seed, so that all
simulators are asked at the same points.
"""

from typing import NamedTuple

import numpy as np

SEED = 0
GRAVITY = 9.81
SPACING = 0.05
"""Of the grid [m]; particles lie on a lattice of half of it, eight to a cell."""
GRID = (24, 16, 14)
"""Nodes along x, y (up), z."""
FLOOR = 0.15
"""Height of the floor [m]: nodes strictly below it are the floor."""
MIDDLE = 0.325
"""Of the box along z [m]."""
DENSITY, YOUNGS_MODULUS, POISSONS_RATIO = 1000.0, 2e4, 0.3
YIELD_STRESS = 300.0
SOFT_DT = 2e-3
FLOOR_FRICTION, PLATE_FRICTION = 0.3, 0.5
PLATE_GAP = 0.01
"""Between plate and dough at the start [m]."""
BALL_RADIUS, BALL_GAP = 0.1, 0.02

RIGID_DT = 1e-3
BOX_HALF_SIZE = 0.1
HIP_MASS, FOOT_MASS, LEG_LENGTH, FOOT_RADIUS = 2.0, 0.5, 0.4, 0.05
LEG_START = (0.5, 0.5)
"""Height of the hip [m] and angle of the leg from the vertical [rad]."""
CONTACT_STIFFNESS, DEPTH_DAMPING, FRICTION_DAMPING, FOOT_FRICTION = 4e3, 5e3, 50.0, 0.6
"""Of simulators with springs and dampers: N/m, N s/m^2, N s/m."""


class Scene(NamedTuple):
    """One question.

    Attributes:
      title: what happens, for the table.
      outcome: what is differentiated.
      parameters: names of what it is differentiated by.
      low, high: range of the starts.
      duration: [s].
    """

    title: str
    outcome: str
    parameters: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    duration: float

    def starts(self, count: int) -> np.ndarray:
        """Parameters, shape (count, num_parameters)."""
        return np.random.default_rng(SEED).uniform(self.low, self.high, (count, len(self.parameters)))


SCENES = {
    "throw": Scene(
        "an elastic block of 512 particles thrown onto the floor",
        "mean x + mean height", ("velocity x", "velocity y"), (0.5, -1.2), (1.5, -0.4), 0.3,
    ),
    "press": Scene(
        "256 particles of von Mises dough pressed by a moving plate",
        "mean squared displacement", ("plate velocity x", "plate velocity y"), (-0.2, -0.4), (0.2, -0.2), 0.1,
    ),
    "slide": Scene(
        "a soft block of 512 particles slides and is slowed by friction",
        "mean x", ("speed", "friction"), (0.4, 0.1), (1.4, 0.4), 0.3,
    ),
    "slide-rigid": Scene(
        "a rigid box slides and is slowed by friction",
        "x", ("speed", "friction"), (0.4, 0.1), (1.4, 0.4), 0.3,
    ),
    "drop": Scene(
        "a rigid ball falls onto a soft slab of 576 particles, two-way",
        "height of the ball", ("velocity y", "mass"), (-1.0, 2.0), (0.0, 5.0), 0.2,
    ),
    "foot": Scene(
        "a leg on a vertical slider, its foot strikes the ground",
        "height of the hip + 0.2 angle of the leg", ("velocity of the hip", "torque"), (-1.5, -2.0), (-0.5, 2.0), 0.3,
    ),
}  # fmt: skip

_BLOCKS = {"throw": (8, 8, 8), "press": (8, 4, 8), "slide": (8, 8, 8), "drop": (12, 4, 12)}
_GAPS = {"throw": 0.02, "press": 0.0, "slide": 0.0, "drop": 0.0}


def particles(scene: str) -> np.ndarray:
    """Positions at the start [m], shape (num_particles, 3)."""
    counts, h = _BLOCKS[scene], SPACING / 2
    lattice = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), axis=-1).reshape(-1, 3) + 0.5
    corner = np.array([0.4 - counts[0] * h / 2, FLOOR + _GAPS[scene], MIDDLE - counts[2] * h / 2])
    return corner + h * lattice


def top(scene: str) -> float:
    """Upper side of the material at the start [m]."""
    return FLOOR + _GAPS[scene] + _BLOCKS[scene][1] * SPACING / 2


def substeps(scene: str, dt: float) -> int:
    return round(SCENES[scene].duration / dt)


def leg_mjcf(dt: float, *, friction: float = FOOT_FRICTION, options: str = "") -> str:
    """The leg as MJCF, z up: a hip on a vertical slider, a hinge with a motor, a foot that is a sphere."""
    hip, angle = LEG_START
    del angle  # the model's zero is the vertical leg
    return f"""<mujoco><option timestep="{dt}" integrator="Euler" cone="pyramidal" iterations="20" {options}/>
      <default><geom contype="0" conaffinity="0"/></default>
      <worldbody><geom name="floor" type="plane" size="5 5 1"/>
        <body name="hip" pos="0 0 {hip}"><joint name="slide" type="slide" axis="0 0 1"/>
          <geom size="0.05" mass="{HIP_MASS}"/>
          <body name="leg"><joint name="hinge" type="hinge" axis="0 -1 0"/>
            <geom name="foot" size="{FOOT_RADIUS}" pos="0 0 -{LEG_LENGTH}" mass="{FOOT_MASS}"/></body></body>
      </worldbody><actuator><motor joint="hinge"/></actuator>
      <contact><pair geom1="floor" geom2="foot" friction="{friction} {friction} 0.005 0.0001 0.0001"/></contact>
    </mujoco>"""


def box_mjcf(dt: float, *, options: str = "") -> str:
    """A box that may slide along x and z and not turn, resting on a plane, z up."""
    return f"""<mujoco><option timestep="{dt}" integrator="Euler" cone="pyramidal" iterations="20" {options}/>
      <default><geom contype="0" conaffinity="0"/></default>
      <worldbody><geom name="floor" type="plane" size="5 5 1"/>
        <body name="box" pos="0 0 {BOX_HALF_SIZE}"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
          <geom name="box" type="box" size="{BOX_HALF_SIZE} {BOX_HALF_SIZE} {BOX_HALF_SIZE}" mass="1"/></body>
      </worldbody>
      <contact><pair geom1="floor" geom2="box" friction="0.3 0.3 0.005 0.0001 0.0001"/></contact></mujoco>"""
