"""NVIDIA Warp in the audit: own kernels, one array per substep, one ``wp.Tape``, as Warp's documentation recommends.

The physics is ours, the derivative Warp's. Kernels do not overwrite what they read, and sums are ``wp.atomic_add``.
"""

import audit_scenes as s
import numpy as np
import warp as wp
from audit_protocol import Problem

wp.config.quiet = True

VERSION = wp.config.version
VARIANTS = {"Warp": "own kernels, one wp.Tape, wp.svd3 for plasticity"}

real, vec3, mat33 = wp.float64, wp.vec3d, wp.mat33d
SPACING, INV, DT = (wp.constant(real(x)) for x in (s.SPACING, 1.0 / s.SPACING, s.SOFT_DT))
VOLUME = wp.constant(real((s.SPACING / 2) ** 3))
MASS = wp.constant(real((s.SPACING / 2) ** 3 * s.DENSITY))
MU = wp.constant(real(s.YOUNGS_MODULUS / (2 * (1 + s.POISSONS_RATIO))))
LAM = wp.constant(real(s.YOUNGS_MODULUS * s.POISSONS_RATIO / ((1 + s.POISSONS_RATIO) * (1 - 2 * s.POISSONS_RATIO))))
YIELD = wp.constant(real(s.YIELD_STRESS))
GRAVITY, RADIUS = wp.constant(real(s.GRAVITY)), wp.constant(real(s.BALL_RADIUS))
FLOOR_NODES = wp.constant(round(s.FLOOR / s.SPACING))
PLATE_FRICTION = wp.constant(real(s.PLATE_FRICTION))
ZERO, ONE, HALF = wp.constant(real(0)), wp.constant(real(1)), wp.constant(real(0.5))
vectors, matrices, reals = wp.array(dtype=vec3), wp.array(dtype=mat33), wp.array(dtype=real)


@wp.kernel
def elastic(C: matrices, F: matrices, F_next: matrices, stress: matrices):
    p = wp.tid()
    eye = wp.identity(n=3, dtype=real)
    new = (eye + DT * C[p]) * F[p]
    F_next[p] = new
    stress[p] = MU * (new * wp.transpose(new) - eye) + LAM * wp.log(wp.determinant(new)) * eye


@wp.kernel
def plastic(C: matrices, F: matrices, F_next: matrices, stress: matrices):
    p = wp.tid()
    eye = wp.identity(n=3, dtype=real)
    trial = (eye + DT * C[p]) * F[p]
    U = mat33(ZERO)
    V = mat33(ZERO)
    sigma = vec3(ZERO)
    wp.svd3(trial, U, sigma, V)
    strain = vec3(wp.log(sigma[0]), wp.log(sigma[1]), wp.log(sigma[2]))
    trace = strain[0] + strain[1] + strain[2]
    mean = vec3(trace / real(3), trace / real(3), trace / real(3))
    deviator = strain - mean
    squared = wp.dot(deviator, deviator)
    limit = YIELD / (real(2) * MU)
    if squared > limit * limit:
        deviator = deviator * (limit / wp.sqrt(squared))
    after = deviator + mean
    stretch = wp.diag(vec3(wp.exp(after[0]), wp.exp(after[1]), wp.exp(after[2])))
    F_next[p] = U * stretch * wp.transpose(V)
    stress[p] = U * wp.diag(real(2) * MU * deviator + real(3) * LAM * mean + real(2) * MU * mean) * wp.transpose(U)


@wp.func
def weight(d: real):
    """Quadratic spline at a distance of d cells."""
    a = wp.abs(d)
    w = real(0.75) - a * a
    if a > HALF:
        w = HALF * (real(1.5) - a) * (real(1.5) - a)
    return w


@wp.kernel
def to_grid(
    x: vectors,
    v: vectors,
    C: matrices,
    stress: matrices,
    momentum: wp.array3d(dtype=vec3),
    mass: wp.array3d(dtype=real),
):
    p = wp.tid()
    X = x[p] * INV
    bx, by, bz = int(X[0] - HALF), int(X[1] - HALF), int(X[2] - HALF)
    A = (-DT * VOLUME * real(4) * INV * INV) * stress[p] + MASS * C[p]
    for i in range(3):
        for j in range(3):
            for k in range(3):
                d = vec3(real(bx + i), real(by + j), real(bz + k)) - X
                w = weight(d[0]) * weight(d[1]) * weight(d[2])
                wp.atomic_add(momentum, bx + i, by + j, bz + k, w * (MASS * v[p] + A * (d * SPACING)))
                wp.atomic_add(mass, bx + i, by + j, bz + k, w * MASS)


@wp.func
def slowed(tangent: vec3, approach: real, friction: real):
    """Coulomb's law on the tangential velocity, for a normal velocity -approach that contact stops."""
    squared = wp.dot(tangent, tangent)
    factor = ZERO
    if squared > real(1e-20):
        factor = wp.max(ZERO, ONE - friction * approach / wp.sqrt(squared))
    return tangent * factor


@wp.kernel
def on_grid(
    momentum: wp.array3d(dtype=vec3), mass: wp.array3d(dtype=real), out: wp.array3d(dtype=vec3),
    friction: reals, plate: vectors, ball_x: vectors, ball_v: vectors, ball_mass: reals, impulse: vectors,
    time: real, plate_height: real, kind: int,
):  # fmt: skip
    """kind: 0 frictional floor, 1 sticky floor and plate, 2 sticky floor and ball."""
    i, j, k = wp.tid()
    m = mass[i, j, k]
    if m > ZERO:
        u = momentum[i, j, k] / m - vec3(ZERO, DT * GRAVITY, ZERO)
        if kind == 1:
            height = plate_height + plate[0][1] * time
            r = u - plate[0]
            if real(j) * SPACING > height and r[1] > ZERO:
                u = plate[0] + slowed(vec3(r[0], ZERO, r[2]), r[1], PLATE_FRICTION)
        if kind == 2:
            d = vec3(real(i), real(j), real(k)) * SPACING - ball_x[0]
            if wp.dot(d, d) < RADIUS * RADIUS:
                n = wp.normalize(d)
                approach = wp.dot(u - ball_v[0], n)
                if approach < ZERO:
                    # Both move on with the velocity of a perfectly inelastic collision along the normal.
                    pair = approach * ball_mass[0] / (ball_mass[0] + m)
                    u = u - pair * n
                    wp.atomic_add(impulse, 0, m * pair * n)
        if j < FLOOR_NODES:
            if kind == 0:
                if u[1] < ZERO:
                    u = slowed(vec3(u[0], ZERO, u[2]), -u[1], friction[0])
            else:
                u = vec3(ZERO, ZERO, ZERO)
        out[i, j, k] = u


@wp.kernel
def move_ball(x: vectors, v: vectors, mass: reals, impulse: vectors, x_next: vectors, v_next: vectors):
    new = v[0] + impulse[0] / mass[0] - vec3(ZERO, DT * GRAVITY, ZERO)
    v_next[0] = new
    x_next[0] = x[0] + DT * new


@wp.kernel
def to_particles(
    x: vectors, grid: wp.array3d(dtype=vec3), x_next: vectors, v_next: vectors, C_next: matrices
):  # fmt: skip
    p = wp.tid()
    X = x[p] * INV
    bx, by, bz = int(X[0] - HALF), int(X[1] - HALF), int(X[2] - HALF)
    v = vec3(ZERO)
    C = mat33(ZERO)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                d = vec3(real(bx + i), real(by + j), real(bz + k)) - X
                u = weight(d[0]) * weight(d[1]) * weight(d[2]) * grid[bx + i, by + j, bz + k]
                v = v + u
                C = C + real(4) * INV * wp.outer(u, d)
    v_next[p] = v
    C_next[p] = C
    x_next[p] = x[p] + DT * v


@wp.kernel
def start_velocities(v0: vectors, v: vectors):
    v[wp.tid()] = v0[0]


@wp.kernel
def mean_of(x: vectors, first: vectors, weights: vec3, squared: real, share: real, out: reals):
    """Sum of weights . x + squared |x - first|^2, times share."""
    p = wp.tid()
    d = x[p] - first[p]
    wp.atomic_add(out, 0, share * (wp.dot(weights, x[p]) + squared * wp.dot(d, d)))


class Soft:
    """A scene of particles; all arrays of all substeps are kept, which the tape needs."""

    def __init__(self, scene: str):
        self.scene, self.steps = scene, s.substeps(scene, s.SOFT_DT)
        first = s.particles(scene)
        self.count = len(first)
        n = self.steps + 1

        def arrays(shape, dtype, how_many=n):
            return [wp.zeros(shape, dtype=dtype, requires_grad=True, device="cpu") for _ in range(how_many)]

        self.x, self.v = arrays(self.count, vec3), arrays(self.count, vec3)
        self.C, self.F, self.stress = (arrays(self.count, mat33) for _ in range(3))
        self.momentum, self.grid = arrays(s.GRID, vec3), arrays(s.GRID, vec3)
        self.mass = arrays(s.GRID, real)
        self.ball_x, self.ball_v, self.impulse = (arrays(1, vec3) for _ in range(3))
        (self.friction,), (self.ball_mass,), (self.out,) = (arrays(1, real, 1) for _ in range(3))
        (self.plate,), (self.v0,) = arrays(1, vec3, 1), arrays(1, vec3, 1)
        self.first = wp.array(first, dtype=vec3, device="cpu")
        self.x[0].assign(first)
        self.F[0].assign(np.tile(np.eye(3), (self.count, 1, 1)))
        self.ball_x[0].assign([[0.4, s.top(scene) + s.BALL_GAP + s.BALL_RADIUS, s.MIDDLE]])
        self.friction.assign([s.FLOOR_FRICTION])
        self.ball_mass.assign([1.0])

    def inputs(self, p: np.ndarray) -> None:
        """Writes the parameters into the arrays that the tape differentiates by."""
        for array in (*self.momentum, *self.mass, *self.grid, *self.impulse, self.out):
            array.zero_()
        if self.scene == "throw":
            self.v0.assign([[p[0], p[1], 0.0]])
        elif self.scene == "slide":
            self.v0.assign([[p[0], 0.0, 0.0]])
            self.friction.assign([p[1]])
        elif self.scene == "press":
            self.plate.assign([[p[0], p[1], 0.0]])
        else:
            self.ball_v[0].assign([[0.0, p[0], 0.0]])
            self.ball_mass.assign([p[1]])

    def run(self) -> None:
        cpu = {"device": "cpu"}
        wp.launch(start_velocities, self.count, inputs=[self.v0], outputs=[self.v[0]], **cpu)
        kind = {"throw": 0, "slide": 0, "press": 1, "drop": 2}[self.scene]
        for t in range(self.steps):
            law = plastic if self.scene == "press" else elastic
            wp.launch(law, self.count, inputs=[self.C[t], self.F[t]], outputs=[self.F[t + 1], self.stress[t]], **cpu)
            particles = [self.x[t], self.v[t], self.C[t], self.stress[t]]
            wp.launch(to_grid, self.count, inputs=particles, outputs=[self.momentum[t], self.mass[t]], **cpu)
            others = [self.friction, self.plate, self.ball_x[t], self.ball_v[t], self.ball_mass, self.impulse[t]]
            numbers = [t * s.SOFT_DT, s.top(self.scene) + s.PLATE_GAP, kind]
            fields = [self.momentum[t], self.mass[t], self.grid[t]]
            wp.launch(on_grid, s.GRID, inputs=[*fields, *others, *numbers], **cpu)
            if kind == 2:
                before = [self.ball_x[t], self.ball_v[t], self.ball_mass, self.impulse[t]]
                wp.launch(move_ball, 1, inputs=before, outputs=[self.ball_x[t + 1], self.ball_v[t + 1]], **cpu)
            after = [self.x[t + 1], self.v[t + 1], self.C[t + 1]]
            wp.launch(to_particles, self.count, inputs=[self.x[t], self.grid[t]], outputs=after, **cpu)
        if kind == 2:
            last, weights, squared, count = self.ball_x[-1], vec3(0.0, 1.0, 0.0), 0.0, 1
        else:
            chosen = {"throw": (1.0, 1.0, 0.0), "slide": (1.0, 0.0, 0.0), "press": (0.0, 0.0, 0.0)}[self.scene]
            last, weights, squared, count = self.x[-1], vec3(*chosen), float(kind == 1), self.count
        numbers = [self.first, weights, squared, 1.0 / count]
        wp.launch(mean_of, count, inputs=[last, *numbers], outputs=[self.out], **cpu)

    def value(self, p: np.ndarray) -> float:
        self.inputs(p)
        self.run()
        return float(self.out.numpy()[0])

    def gradient(self, p: np.ndarray) -> np.ndarray:
        self.inputs(p)
        tape = wp.Tape()
        with tape:
            self.run()
        tape.backward(self.out)
        found = {
            "throw": lambda: self.v0.grad.numpy()[0, :2],
            "slide": lambda: [self.v0.grad.numpy()[0, 0], self.friction.grad.numpy()[0]],
            "press": lambda: self.plate.grad.numpy()[0, :2],
            "drop": lambda: [self.ball_v[0].grad.numpy()[0, 1], self.ball_mass.grad.numpy()[0]],
        }[self.scene]()
        found = np.array(found, dtype=np.float64)
        tape.zero()
        return found


def build(variant: str, scene: str) -> Problem:
    if scene in ("slide-rigid", "foot"):
        from with_warp_rigid import Rigid

        made = Rigid(scene)
    else:
        made = Soft(scene)
    return Problem(made.value, made.gradient, "float64", VARIANTS[variant])
