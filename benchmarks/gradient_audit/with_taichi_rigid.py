"""A sliding box and a leg as Taichi kernels, with springs and dampers for contact; see ``with_taichi``."""

import audit_scenes as s
import numpy as np
import taichi as ti

DT = s.RIGID_DT
HIP, FOOT, LENGTH = s.HIP_MASS, s.FOOT_MASS, s.LEG_LENGTH
INERTIA = 0.4 * s.FOOT_MASS * s.FOOT_RADIUS**2


@ti.func
def normal_force(depth, rate):
    """Spring, and damping while the depth grows; rate: of the depth."""
    return ti.max(0.0, s.CONTACT_STIFFNESS * depth + s.DEPTH_DAMPING * depth * ti.max(rate, 0.0))


@ti.func
def friction_force(speed, limit):
    return -ti.max(-limit, ti.min(s.FRICTION_DAMPING * speed, limit))


@ti.data_oriented
class Rigid:
    """Box or leg; coordinates of all substeps lie in one field, each written once."""

    def __init__(self, scene: str):
        ti.init(arch=ti.cpu, default_fp=ti.f64, cpu_max_num_threads=2, log_level=ti.WARN)
        self.is_leg, self.steps = scene == "foot", s.substeps(scene, s.RIGID_DT)
        self.q, self.v = (ti.field(ti.f64, shape=(self.steps + 1, 2), needs_grad=True) for _ in range(2))
        self.p = ti.field(ti.f64, shape=2, needs_grad=True)
        self.out = ti.field(ti.f64, shape=(), needs_grad=True)
        self.q[0, 1] = s.LEG_START[1] if self.is_leg else 0.0

    @ti.kernel
    def begin(self):
        for i in range(1):
            self.v[i, 0] = self.p[0]

    @ti.kernel
    def box(self, t: ti.i32):
        """Coordinates: x and height above the rest pose of a box of 1 kg."""
        for i in range(1):  # noqa: B007
            fn = 0.0
            if self.q[t, 1] < 0:
                fn = normal_force(-self.q[t, 1], -self.v[t, 1])
            ft = friction_force(self.v[t, 0], self.p[1] * fn)
            v0, v1 = self.v[t, 0] + DT * ft, self.v[t, 1] + DT * (fn - s.GRAVITY)
            self.v[t + 1, 0] = v0
            self.v[t + 1, 1] = v1
            self.q[t + 1, 0] = self.q[t, 0] + DT * v0
            self.q[t + 1, 1] = self.q[t, 1] + DT * v1

    @ti.kernel
    def leg(self, t: ti.i32):
        """Coordinates: height of the hip above its start, angle of the leg from the vertical."""
        for i in range(1):  # noqa: B007
            sine, cosine = ti.sin(self.q[t, 1]), ti.cos(self.q[t, 1])
            rate, turn = self.v[t, 0], self.v[t, 1]
            depth = s.FOOT_RADIUS - (s.LEG_START[0] + self.q[t, 0] - LENGTH * cosine)
            along, up = LENGTH * cosine + s.FOOT_RADIUS, LENGTH * sine
            fn = 0.0
            if depth > 0:
                fn = normal_force(depth, -(rate + up * turn))
            ft = friction_force(along * turn, s.FOOT_FRICTION * fn)
            force = fn - (HIP + FOOT) * s.GRAVITY - FOOT * LENGTH * cosine * turn * turn
            torque = self.p[1] + along * ft + up * fn - FOOT * s.GRAVITY * LENGTH * sine
            a, b, c = HIP + FOOT, FOOT * LENGTH * sine, FOOT * LENGTH * LENGTH + INERTIA
            determinant = a * c - b * b
            v0 = rate + DT * (c * force - b * torque) / determinant
            v1 = turn + DT * (a * torque - b * force) / determinant
            self.v[t + 1, 0] = v0
            self.v[t + 1, 1] = v1
            self.q[t + 1, 0] = self.q[t, 0] + DT * v0
            self.q[t + 1, 1] = self.q[t, 1] + DT * v1

    @ti.kernel
    def outcome(self):
        for i in range(1):  # noqa: B007
            if ti.static(self.is_leg):
                self.out[None] += s.LEG_START[0] + self.q[self.steps, 0] + 0.2 * self.q[self.steps, 1]
            else:
                self.out[None] += self.q[self.steps, 0]

    def run(self) -> None:
        self.begin()
        for t in range(self.steps):
            if self.is_leg:
                self.leg(t)
            else:
                self.box(t)
        self.outcome()

    def value(self, p: np.ndarray) -> float:
        self.p.from_numpy(p)
        self.out[None] = 0.0
        self.run()
        return float(self.out[None])

    def gradient(self, p: np.ndarray) -> np.ndarray:
        self.p.from_numpy(p)
        self.out[None] = 0.0
        with ti.ad.Tape(loss=self.out):
            self.run()
        return self.p.grad.to_numpy()
