"""Taichi in the audit: own kernels, fields with an axis of substeps, ``ti.ad.Tape``, as its documentation recommends.

The physics is ours, the derivative Taichi's. Elements of fields are not written after they were read, and sums are
``+=`` on fields (Taichi's global data access rules); particles and the nodes that they reach are one loop (its kernel
simplicity rule).
"""

import audit_scenes as s
import numpy as np
import taichi as ti
from audit_protocol import Problem

VERSION = ".".join(str(n) for n in ti.__version__)
VARIANTS = {
    "Taichi": "own kernels, ti.ad.Tape, ti.svd for plasticity",
    "Taichi (own SVD adjoint)": "own kernels, ti.ad.Tape, adjoint of the SVD written by hand, as PlasticineLab does",
}

MASS, VOLUME = (s.SPACING / 2) ** 3 * s.DENSITY, (s.SPACING / 2) ** 3
MU = s.YOUNGS_MODULUS / (2 * (1 + s.POISSONS_RATIO))
LAM = s.YOUNGS_MODULUS * s.POISSONS_RATIO / ((1 + s.POISSONS_RATIO) * (1 - 2 * s.POISSONS_RATIO))
INV, DT, FLOOR_NODES = 1.0 / s.SPACING, s.SOFT_DT, round(s.FLOOR / s.SPACING)
KINDS = {"throw": 0, "slide": 0, "press": 1, "drop": 2}


@ti.func
def weight(d):
    """Quadratic spline at a distance of d cells."""
    a = ti.abs(d)
    return ti.select(a > 0.5, 0.5 * (1.5 - a) ** 2, 0.75 - a * a)


@ti.func
def slowed(tangent, approach, friction):
    """Coulomb's law on the tangential velocity, for a normal velocity -approach that contact stops."""
    squared = tangent.dot(tangent)
    factor = 0.0
    if squared > 1e-20:
        factor = ti.max(0.0, 1.0 - friction * approach / ti.sqrt(squared))
    return tangent * factor


@ti.data_oriented
class Soft:
    """A scene of particles; all fields of all substeps are kept, which the tape needs."""

    def __init__(self, scene: str, own_adjoint: bool):
        ti.init(arch=ti.cpu, default_fp=ti.f64, cpu_max_num_threads=2, log_level=ti.WARN)
        self.scene, self.kind, self.steps = scene, KINDS[scene], s.substeps(scene, s.SOFT_DT)
        self.plate_height = s.top(scene) + s.PLATE_GAP
        self.ball_height = s.top(scene) + s.BALL_GAP + s.BALL_RADIUS
        self.own_adjoint = own_adjoint
        first = s.particles(scene)
        n, self.count = self.steps + 1, len(first)

        def vector(*shape):
            return ti.Vector.field(3, ti.f64, shape=shape, needs_grad=True)

        def matrix(*shape):
            return ti.Matrix.field(3, 3, ti.f64, shape=shape, needs_grad=True)

        self.x, self.v = vector(n, self.count), vector(n, self.count)
        self.C, self.F, self.trial, self.stress = (matrix(n, self.count) for _ in range(4))
        self.U, self.V, self.sigma = matrix(n, self.count), matrix(n, self.count), vector(n, self.count)
        self.momentum, self.grid = vector(n, *s.GRID), vector(n, *s.GRID)
        self.mass = ti.field(ti.f64, shape=(n, *s.GRID), needs_grad=True)
        self.ball_x, self.ball_v, self.impulse = vector(n), vector(n), vector(n)
        self.p = ti.field(ti.f64, shape=2, needs_grad=True)
        self.out = ti.field(ti.f64, shape=(), needs_grad=True)
        self.first = ti.Vector.field(3, ti.f64, shape=self.count)
        self.first.from_numpy(first)

    @ti.kernel
    def clear(self):
        """Outside the tape: fields that are summed into, and the state at the start."""
        for index in ti.grouped(self.mass):
            self.mass[index] = 0.0
            self.momentum[index] = ti.Vector.zero(ti.f64, 3)
            self.grid[index] = ti.Vector.zero(ti.f64, 3)
        for t, p in self.x:
            self.v[t, p] = ti.Vector.zero(ti.f64, 3)
            self.C[t, p] = ti.Matrix.zero(ti.f64, 3, 3)
            if t == 0:
                self.x[t, p] = self.first[p]
                self.F[t, p] = ti.Matrix.identity(ti.f64, 3)
        for t in self.impulse:
            self.impulse[t] = ti.Vector.zero(ti.f64, 3)
            self.ball_x[t] = ti.Vector([0.4, self.ball_height, s.MIDDLE])
            self.ball_v[t] = ti.Vector.zero(ti.f64, 3)
        self.out[None] = 0.0

    @ti.kernel
    def begin(self):
        for p in range(self.count):
            if ti.static(self.scene == "throw"):
                self.v[0, p] += ti.Vector([self.p[0], self.p[1], 0.0])
            if ti.static(self.scene == "slide"):
                self.v[0, p] += ti.Vector([self.p[0], 0.0, 0.0])

    @ti.kernel
    def begin_ball(self):
        for i in range(1):
            self.ball_v[i] += ti.Vector([0.0, self.p[0], 0.0])

    @ti.kernel
    def elastic(self, t: ti.i32):
        for p in range(self.count):
            eye = ti.Matrix.identity(ti.f64, 3)
            new = (eye + DT * self.C[t, p]) @ self.F[t, p]
            self.F[t + 1, p] = new
            self.stress[t, p] = MU * (new @ new.transpose() - eye) + LAM * ti.log(new.determinant()) * eye

    @ti.kernel
    def predict(self, t: ti.i32):
        for p in range(self.count):
            self.trial[t, p] = (ti.Matrix.identity(ti.f64, 3) + DT * self.C[t, p]) @ self.F[t, p]

    @ti.kernel
    def decompose(self, t: ti.i32):
        for p in range(self.count):
            U, sigma, V = ti.svd(self.trial[t, p], ti.f64)
            self.U[t, p], self.V[t, p] = U, V
            self.sigma[t, p] = ti.Vector([sigma[0, 0], sigma[1, 1], sigma[2, 2]])

    @ti.kernel
    def decompose_adjoint(self, t: ti.i32):
        """Reverse mode of the SVD; differences of squared singular values are kept from zero."""
        for p in range(self.count):
            U, V, sigma = self.U[t, p], self.V[t, p], self.sigma[t, p]
            A, B = U.transpose() @ self.U.grad[t, p], V.transpose() @ self.V.grad[t, p]
            inner = ti.Matrix.zero(ti.f64, 3, 3)
            for i, j in ti.static(ti.ndrange(3, 3)):
                if ti.static(i == j):
                    inner[i, i] = self.sigma.grad[t, p][i]
                else:
                    gap = sigma[j] ** 2 - sigma[i] ** 2
                    gap = ti.max(gap, 1e-6) if gap >= 0 else ti.min(gap, -1e-6)
                    inner[i, j] = ((A[i, j] - A[j, i]) * sigma[j] + sigma[i] * (B[i, j] - B[j, i])) / gap
            self.trial.grad[t, p] += U @ inner @ V.transpose()

    @ti.ad.grad_replaced
    def decompose_by_hand(self, t):
        self.decompose(t)

    @ti.ad.grad_for(decompose_by_hand)
    def decompose_by_hand_grad(self, t):
        self.decompose_adjoint(t)

    @ti.kernel
    def plastic(self, t: ti.i32):
        for p in range(self.count):
            U, V, sigma = self.U[t, p], self.V[t, p], self.sigma[t, p]
            strain = ti.Vector([ti.log(sigma[0]), ti.log(sigma[1]), ti.log(sigma[2])])
            mean = (strain[0] + strain[1] + strain[2]) / 3.0
            deviator = strain - mean
            squared = deviator.dot(deviator)
            limit, factor = s.YIELD_STRESS / (2 * MU), 1.0
            if squared > limit * limit:
                factor = limit / ti.sqrt(squared)
            after = deviator * factor + mean
            stretch, tau = ti.Matrix.zero(ti.f64, 3, 3), ti.Matrix.zero(ti.f64, 3, 3)
            for i in ti.static(range(3)):
                stretch[i, i] = ti.exp(after[i])
                tau[i, i] = 2 * MU * after[i] + 3 * LAM * mean
            self.F[t + 1, p] = U @ stretch @ V.transpose()
            self.stress[t, p] = U @ tau @ U.transpose()

    @ti.kernel
    def to_grid(self, t: ti.i32):
        for p, i, j, k in ti.ndrange(self.count, 3, 3, 3):
            X = self.x[t, p] * INV
            A = (-DT * VOLUME * 4 * INV * INV) * self.stress[t, p] + MASS * self.C[t, p]
            node = ti.cast(X - 0.5, ti.i32) + ti.Vector([i, j, k])
            d = ti.cast(node, ti.f64) - X
            w = weight(d[0]) * weight(d[1]) * weight(d[2])
            self.momentum[t, node[0], node[1], node[2]] += w * (MASS * self.v[t, p] + A @ (d * s.SPACING))
            self.mass[t, node[0], node[1], node[2]] += w * MASS

    @ti.kernel
    def on_grid(self, t: ti.i32):
        for i, j, k in ti.ndrange(*s.GRID):
            m = self.mass[t, i, j, k]
            if m > 0:
                u = self.momentum[t, i, j, k] / m - ti.Vector([0.0, DT * s.GRAVITY, 0.0])
                if ti.static(self.kind == 1):
                    plate = ti.Vector([self.p[0], self.p[1], 0.0])
                    height = self.plate_height + self.p[1] * (t * DT)
                    r = u - plate
                    if j * s.SPACING > height and r[1] > 0:
                        u = plate + slowed(ti.Vector([r[0], 0.0, r[2]]), r[1], s.PLATE_FRICTION)
                if ti.static(self.kind == 2):
                    d = ti.Vector([i, j, k]) * s.SPACING - self.ball_x[t]
                    if d.dot(d) < s.BALL_RADIUS**2:
                        n = d / ti.sqrt(d.dot(d))
                        approach = (u - self.ball_v[t]).dot(n)
                        if approach < 0:
                            pair = approach * self.p[1] / (self.p[1] + m)
                            u = u - pair * n
                            self.impulse[t] += m * pair * n
                if j < FLOOR_NODES:
                    if ti.static(self.kind == 0):
                        friction = s.FLOOR_FRICTION
                        if ti.static(self.scene == "slide"):
                            friction = self.p[1]
                        if u[1] < 0:
                            u = slowed(ti.Vector([u[0], 0.0, u[2]]), -u[1], friction)
                    else:
                        u = u * 0.0
                self.grid[t, i, j, k] = u

    @ti.kernel
    def move_ball(self, t: ti.i32):
        for i in range(1):  # noqa: B007
            new = self.ball_v[t] + self.impulse[t] / self.p[1] - ti.Vector([0.0, DT * s.GRAVITY, 0.0])
            self.ball_v[t + 1] = new
            self.ball_x[t + 1] = self.ball_x[t] + DT * new

    @ti.kernel
    def to_particles(self, t: ti.i32):
        for p, i, j, k in ti.ndrange(self.count, 3, 3, 3):
            X = self.x[t, p] * INV
            node = ti.cast(X - 0.5, ti.i32) + ti.Vector([i, j, k])
            d = ti.cast(node, ti.f64) - X
            u = weight(d[0]) * weight(d[1]) * weight(d[2]) * self.grid[t, node[0], node[1], node[2]]
            self.v[t + 1, p] += u
            self.C[t + 1, p] += 4 * INV * u.outer_product(d)

    @ti.kernel
    def move(self, t: ti.i32):
        for p in range(self.count):
            self.x[t + 1, p] = self.x[t, p] + DT * self.v[t + 1, p]

    @ti.kernel
    def outcome(self):
        for p in range(self.count):
            x = self.x[self.steps, p]
            if ti.static(self.scene == "throw"):
                self.out[None] += (x[0] + x[1]) / self.count
            if ti.static(self.scene == "slide"):
                self.out[None] += x[0] / self.count
            if ti.static(self.scene == "press"):
                d = x - self.first[p]
                self.out[None] += d.dot(d) / self.count

    @ti.kernel
    def ball_outcome(self):
        for i in range(1):  # noqa: B007
            self.out[None] += self.ball_x[self.steps][1]

    def run(self) -> None:
        if self.kind == 2:
            self.begin_ball()
        else:
            self.begin()
        for t in range(self.steps):
            if self.kind == 1:
                self.predict(t)
                if self.own_adjoint:
                    self.decompose_by_hand(t)
                else:
                    self.decompose(t)
                self.plastic(t)
            else:
                self.elastic(t)
            self.to_grid(t)
            self.on_grid(t)
            if self.kind == 2:
                self.move_ball(t)
            self.to_particles(t)
            self.move(t)
        if self.kind == 2:
            self.ball_outcome()
        else:
            self.outcome()

    def value(self, p: np.ndarray) -> float:
        self.p.from_numpy(p)
        self.clear()
        self.run()
        return float(self.out[None])

    def gradient(self, p: np.ndarray) -> np.ndarray:
        self.p.from_numpy(p)
        self.clear()
        with ti.ad.Tape(loss=self.out):
            self.run()
        return self.p.grad.to_numpy()


def build(variant: str, scene: str) -> Problem:
    own_adjoint = "own SVD" in variant
    if own_adjoint and scene != "press":
        from audit_protocol import NotSupported

        raise NotSupported("a variant for plasticity only")
    if scene in ("slide-rigid", "foot"):
        from with_taichi_rigid import Rigid

        made = Rigid(scene)
    else:
        made = Soft(scene, own_adjoint)
    return Problem(made.value, made.gradient, "float64", VARIANTS[variant])
