"""Genesis World in the audit: ``requires_grad=True``, gradients through ``torch`` as its documentation shows.

Its setters of velocities and ``control_dofs_force`` take tensors that require gradients. ``set_friction`` takes a
number, so the derivative by friction is missing and its entry counts as zero.
"""

import tempfile
from importlib.metadata import version
from pathlib import Path

import audit_scenes as s
import genesis as gs
import numpy as np
import torch
from audit_protocol import NotTried, Problem

VERSION = version("genesis-world")
VARIANTS = {"Genesis": "requires_grad=True, precision 64"}
RIGID_DT = 2e-3


def new_scene(dt: float, **options) -> "gs.Scene":
    gs.init(backend=gs.cpu, precision="64", logging_level="error")
    simulation = gs.options.SimOptions(dt=dt, substeps=1, requires_grad=True, gravity=(0.0, 0.0, -s.GRAVITY))
    return gs.Scene(sim_options=simulation, show_viewer=False, **options)


def tensor(values: object) -> torch.Tensor:
    return torch.as_tensor(values, dtype=torch.float64)


class Audited:
    """A scene whose outcome is a torch number; subclasses set the start and read the end."""

    def outcome(self, p: torch.Tensor) -> torch.Tensor:
        raise NotImplementedError

    def value(self, p: np.ndarray) -> float:
        return float(self.outcome(tensor(p)).detach())

    def gradient(self, p: np.ndarray) -> np.ndarray:
        parameters = tensor(p).clone().requires_grad_()
        self.outcome(parameters).backward()
        return np.zeros(len(p)) if parameters.grad is None else parameters.grad.numpy().copy()


class Slide(Audited):
    def __init__(self):
        self.scene, half = new_scene(RIGID_DT), s.BOX_HALF_SIZE
        self.plane = self.scene.add_entity(gs.morphs.Plane())
        box = gs.morphs.Box(pos=(0.0, 0.0, half), size=(2 * half, 2 * half, 2 * half))
        self.box = self.scene.add_entity(box, material=gs.materials.Rigid(rho=1.0 / (2 * half) ** 3))
        self.scene.build()

    def outcome(self, p: torch.Tensor) -> torch.Tensor:
        self.scene.reset()
        self.plane.set_friction(float(p[1].detach()))
        self.box.set_friction(float(p[1].detach()))
        self.box.set_dofs_velocity(torch.cat([p[:1], tensor([0.0] * 5)]))
        for _ in range(s.substeps("slide-rigid", RIGID_DT)):
            self.scene.step()
        return self.box.get_state().pos.reshape(-1)[0]


class Foot(Audited):
    def __init__(self):
        self.scene = new_scene(RIGID_DT)
        plane = self.scene.add_entity(gs.morphs.Plane())
        text = s.leg_mjcf(RIGID_DT)
        text = text[: text.index("<contact>")] + "</mujoco>"
        text = text.replace('<geom name="foot"', '<geom name="foot" contype="1" conaffinity="1"')
        text = text.replace('<geom name="floor" type="plane" size="5 5 1"/>', "")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "leg.xml"
            path.write_text(text)
            self.leg = self.scene.add_entity(gs.morphs.MJCF(file=str(path)))
            self.scene.build()
        for entity in (plane, self.leg):
            entity.set_friction(s.FOOT_FRICTION)

    def outcome(self, p: torch.Tensor) -> torch.Tensor:
        self.scene.reset()
        self.leg.set_dofs_position(tensor([0.0, s.LEG_START[1]]))
        self.leg.set_dofs_velocity(torch.cat([p[:1], tensor([0.0])]))
        for _ in range(s.substeps("foot", RIGID_DT)):
            self.leg.control_dofs_force(torch.cat([tensor([0.0]), p[1:]]))
            self.scene.step()
        position = self.scene.rigid_solver.get_state().qpos.reshape(-1)[-2:]
        return s.LEG_START[0] + position[0] + 0.2 * position[1]


class Throw(Audited):
    def __init__(self):
        bounds = gs.options.MPMOptions(
            lower_bound=(0.0, 0.0, 0.0), upper_bound=(1.2, 0.7, 0.8), grid_density=1 / s.SPACING,
            particle_size=s.SPACING / 2,
        )  # fmt: skip
        self.scene = new_scene(s.SOFT_DT, mpm_options=bounds)
        law = gs.materials.MPM.Elastic(
            E=s.YOUNGS_MODULUS, nu=s.POISSONS_RATIO, rho=s.DENSITY, model="neohooken", sampler="regular"
        )
        block = gs.morphs.Box(pos=(0.4, s.MIDDLE, s.FLOOR + 0.1 + 0.02), size=(0.2, 0.2, 0.2))
        self.block = self.scene.add_entity(block, material=law)
        self.scene.build()

    def outcome(self, p: torch.Tensor) -> torch.Tensor:
        self.scene.reset()
        velocity = torch.stack([p[0], 0.0 * p[0], p[1]])
        self.block.set_velocity(torch.tile(velocity, (self.block.n_particles, 1)))
        for _ in range(s.substeps("throw", s.SOFT_DT)):
            self.scene.step()
        x = self.block.get_state().pos.reshape(-1, 3)
        return x[:, 0].mean() + x[:, 2].mean()


def build(variant: str, scene: str) -> Problem:
    known = {"throw": Throw, "slide-rigid": Slide, "foot": Foot}
    if scene not in known:
        raise NotTried("this scene is not written for Genesis yet")
    made = known[scene]()
    return Problem(made.value, made.gradient, "float64", VARIANTS[variant])
