"""A sliding box and a leg as Warp kernels, with springs and dampers for contact; see ``with_warp``."""

import audit_scenes as s
import numpy as np
import warp as wp

real = wp.float64
reals = wp.array(dtype=real)
DT, GRAVITY = wp.constant(real(s.RIGID_DT)), wp.constant(real(s.GRAVITY))
HIP, FOOT, LENGTH = (wp.constant(real(x)) for x in (s.HIP_MASS, s.FOOT_MASS, s.LEG_LENGTH))
RADIUS, START = wp.constant(real(s.FOOT_RADIUS)), wp.constant(real(s.LEG_START[0]))
INERTIA = wp.constant(real(0.4 * s.FOOT_MASS * s.FOOT_RADIUS**2))
STIFFNESS, DAMPING = wp.constant(real(s.CONTACT_STIFFNESS)), wp.constant(real(s.DEPTH_DAMPING))
SLIDING, FOOT_FRICTION = wp.constant(real(s.FRICTION_DAMPING)), wp.constant(real(s.FOOT_FRICTION))
ZERO = wp.constant(real(0))


@wp.func
def normal_force(depth: real, rate: real):
    """Spring, and damping while the depth grows; rate: of the depth."""
    return wp.max(ZERO, STIFFNESS * depth + DAMPING * depth * wp.max(rate, ZERO))


@wp.func
def friction_force(speed: real, limit: real):
    return -wp.clamp(SLIDING * speed, -limit, limit)


@wp.kernel
def box_step(t: int, q: wp.array2d(dtype=real), v: wp.array2d(dtype=real), parameters: reals):
    """Coordinates: x and height above the rest pose of a box of 1 kg."""
    fn = real(0)
    if q[t, 1] < ZERO:
        fn = normal_force(-q[t, 1], -v[t, 1])
    ft = friction_force(v[t, 0], parameters[1] * fn)
    v0 = v[t, 0] + DT * ft
    v1 = v[t, 1] + DT * (fn - GRAVITY)
    v[t + 1, 0] = v0
    v[t + 1, 1] = v1
    q[t + 1, 0] = q[t, 0] + DT * v0
    q[t + 1, 1] = q[t, 1] + DT * v1


@wp.kernel
def leg_step(t: int, q: wp.array2d(dtype=real), v: wp.array2d(dtype=real), parameters: reals):
    """Coordinates: height of the hip above its start, angle of the leg from the vertical."""
    sine, cosine = wp.sin(q[t, 1]), wp.cos(q[t, 1])
    rate, turn = v[t, 0], v[t, 1]
    depth = RADIUS - (START + q[t, 0] - LENGTH * cosine)
    along, up = LENGTH * cosine + RADIUS, LENGTH * sine
    fn = real(0)
    if depth > ZERO:
        fn = normal_force(depth, -(rate + up * turn))
    ft = friction_force(along * turn, FOOT_FRICTION * fn)
    force = fn - (HIP + FOOT) * GRAVITY - FOOT * LENGTH * cosine * turn * turn
    torque = parameters[1] + along * ft + up * fn - FOOT * GRAVITY * LENGTH * sine
    a, b, c = HIP + FOOT, FOOT * LENGTH * sine, FOOT * LENGTH * LENGTH + INERTIA
    determinant = a * c - b * b
    new_rate = rate + DT * (c * force - b * torque) / determinant
    new_turn = turn + DT * (a * torque - b * force) / determinant
    v[t + 1, 0] = new_rate
    v[t + 1, 1] = new_turn
    q[t + 1, 0] = q[t, 0] + DT * new_rate
    q[t + 1, 1] = q[t, 1] + DT * new_turn


@wp.kernel
def first_velocity(parameters: reals, v: wp.array2d(dtype=real)):
    v[0, 0] = parameters[0]


@wp.kernel
def last(t: int, q: wp.array2d(dtype=real), weight: real, offset: real, out: reals):
    out[0] = offset + q[t, 0] + weight * q[t, 1]


class Rigid:
    """Box or leg; coordinates of all substeps lie in one array, each row written once."""

    def __init__(self, scene: str):
        self.is_leg, self.steps = scene == "foot", s.substeps(scene, s.RIGID_DT)

        def zeros(shape):
            return wp.zeros(shape, dtype=real, requires_grad=True, device="cpu")

        self.q, self.v = zeros((self.steps + 1, 2)), zeros((self.steps + 1, 2))
        self.parameters, self.out = zeros(2), zeros(1)
        start = np.zeros((self.steps + 1, 2))
        start[0, 1] = s.LEG_START[1] if self.is_leg else 0.0
        self.q.assign(start)

    def run(self) -> None:
        cpu = {"device": "cpu"}
        wp.launch(first_velocity, 1, inputs=[self.parameters], outputs=[self.v], **cpu)
        for t in range(self.steps):
            kernel = leg_step if self.is_leg else box_step
            wp.launch(kernel, 1, inputs=[t, self.q, self.v, self.parameters], **cpu)
        weights = (0.2, s.LEG_START[0]) if self.is_leg else (0.0, 0.0)
        wp.launch(last, 1, inputs=[self.steps, self.q, *weights], outputs=[self.out], **cpu)

    def value(self, p: np.ndarray) -> float:
        self.parameters.assign(p)
        self.run()
        return float(self.out.numpy()[0])

    def gradient(self, p: np.ndarray) -> np.ndarray:
        self.parameters.assign(p)
        tape = wp.Tape()
        with tape:
            self.run()
        tape.backward(self.out)
        found = self.parameters.grad.numpy().astype(np.float64)
        tape.zero()
        return found
