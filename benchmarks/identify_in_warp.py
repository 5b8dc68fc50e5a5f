"""A body and a pin in NVIDIA Warp: the simulator that makes the records of ``identify_other_world.py``.

    opponents/bin/python benchmarks/identify_in_warp.py scene.npz particles.npz

It shares no code with rewax: MLS-MPM with quadratic splines as kernels of Warp, in float32 on the CPU. A body without a
yield stress is fixed corotated, one with a yield stress is plasticine (Hencky, von Mises). The pin acts on the grid's
nodes inside of it, with Coulomb friction, and on no others. Nodes below the floor do not move down or along it.
"""

import sys

import numpy as np
import warp as wp

wp.config.quiet = True
vectors, matrices = wp.array(dtype=wp.vec3), wp.array(dtype=wp.mat33)


@wp.struct
class Scene:
    dt: float
    dx: float
    origin: wp.vec3
    mass: float
    volume: float
    mu: float
    lam: float
    yield_stress: float
    gravity: float
    floor: float
    low: wp.vec3
    high: wp.vec3
    radius: float
    half_length: float
    friction: float


@wp.kernel
def stretch(s: Scene, C: matrices, F: matrices, stress: matrices):
    p = wp.tid()
    eye = wp.identity(n=3, dtype=float)
    new = (eye + s.dt * C[p]) * F[p]
    U = wp.mat33(0.0)
    V = wp.mat33(0.0)
    sigma = wp.vec3(0.0)
    wp.svd3(new, U, sigma, V)
    if s.yield_stress > 0.0:
        strain = wp.vec3(wp.log(sigma[0]), wp.log(sigma[1]), wp.log(sigma[2]))
        trace = strain[0] + strain[1] + strain[2]
        mean = wp.vec3(trace / 3.0)
        deviator = strain - mean
        limit = s.yield_stress / (2.0 * s.mu)
        length = wp.length(deviator)
        if length > limit:
            deviator = deviator * (limit / length)
        strain = deviator + mean
        new = U * wp.diag(wp.vec3(wp.exp(strain[0]), wp.exp(strain[1]), wp.exp(strain[2]))) * wp.transpose(V)
        stress[p] = U * wp.diag(2.0 * s.mu * strain + wp.vec3(s.lam * trace)) * wp.transpose(U)
    else:
        J = wp.determinant(new)
        R = U * wp.transpose(V)
        stress[p] = 2.0 * s.mu * (new - R) * wp.transpose(new) + s.lam * J * (J - 1.0) * eye
    F[p] = new


@wp.func
def weights(f: wp.vec3):
    a = wp.vec3(1.5) - f
    b = f - wp.vec3(1.0)
    c = f - wp.vec3(0.5)
    return wp.matrix_from_rows(0.5 * wp.cw_mul(a, a), wp.vec3(0.75) - wp.cw_mul(b, b), 0.5 * wp.cw_mul(c, c))


@wp.kernel
def scatter(
    s: Scene, x: vectors, v: vectors, C: matrices, stress: matrices,
    momentum: wp.array3d(dtype=wp.vec3), mass: wp.array3d(dtype=float),
):  # fmt: skip
    p = wp.tid()
    at = (x[p] - s.origin) / s.dx
    i0, j0, k0 = int(at[0] - 0.5), int(at[1] - 0.5), int(at[2] - 0.5)
    f = at - wp.vec3(float(i0), float(j0), float(k0))
    w = weights(f)
    affine = (-s.dt * s.volume * 4.0 / (s.dx * s.dx)) * stress[p] + s.mass * C[p]
    for i in range(3):
        for j in range(3):
            for k in range(3):
                away = (wp.vec3(float(i), float(j), float(k)) - f) * s.dx
                share = w[i, 0] * w[j, 1] * w[k, 2]
                wp.atomic_add(momentum, i0 + i, j0 + j, k0 + k, share * (s.mass * v[p] + affine * away))
                wp.atomic_add(mass, i0 + i, j0 + j, k0 + k, share * s.mass)


@wp.kernel
def contact(
    s: Scene, center: wp.vec3, tool: wp.vec3, momentum: wp.array3d(dtype=wp.vec3), mass: wp.array3d(dtype=float)
):
    i, j, k = wp.tid()
    m = mass[i, j, k]
    if m <= 0.0:
        return
    u = momentum[i, j, k] / m - wp.vec3(0.0, s.dt * s.gravity, 0.0)
    place = s.origin + s.dx * wp.vec3(float(i), float(j), float(k))
    arm = place - center
    arm = arm - wp.vec3(0.0, 0.0, wp.clamp(arm[2], -s.half_length, s.half_length))
    distance = wp.length(arm)
    if distance < s.radius and distance > 0.0:
        normal = arm / distance
        relative = u - tool
        approach = wp.dot(relative, normal)
        if approach < 0.0:
            along = relative - approach * normal
            speed = wp.length(along)
            u = tool + along * wp.max(0.0, 1.0 + s.friction * approach / wp.max(speed, 1.0e-12))
    for axis in range(3):
        if axis != 1 and place[axis] < s.low[axis] - 1.0e-6:
            u[axis] = wp.max(u[axis], 0.0)
        if axis != 1 and place[axis] > s.high[axis] + 1.0e-6:
            u[axis] = wp.min(u[axis], 0.0)
    if place[1] < s.floor - 1.0e-6 and u[1] < 0.0:
        u = wp.vec3(0.0)
    momentum[i, j, k] = u


@wp.kernel
def gather(s: Scene, velocity: wp.array3d(dtype=wp.vec3), x: vectors, v: vectors, C: matrices):
    p = wp.tid()
    at = (x[p] - s.origin) / s.dx
    i0, j0, k0 = int(at[0] - 0.5), int(at[1] - 0.5), int(at[2] - 0.5)
    f = at - wp.vec3(float(i0), float(j0), float(k0))
    w = weights(f)
    new = wp.vec3(0.0)
    slope = wp.mat33(0.0)
    for i in range(3):
        for j in range(3):
            for k in range(3):
                away = (wp.vec3(float(i), float(j), float(k)) - f) * s.dx
                u = w[i, 0] * w[j, 1] * w[k, 2] * velocity[i0 + i, j0 + j, k0 + k]
                new = new + u
                slope = slope + 4.0 / (s.dx * s.dx) * wp.outer(u, away)
    v[p] = new
    C[p] = slope
    x[p] = x[p] + s.dt * new


def simulate(given: dict[str, np.ndarray]) -> np.ndarray:
    """Particles before the first control step and after each [m], shape (num_steps + 1, num_particles, 3).

    Args:
      given: ``rest`` (N, 3) and ``centers`` of the pin before the first step and after each (num_steps + 1, 3) [m],
        ``shape`` of the grid, ``control_dt``, ``substeps`` of a control step; and the numbers of ``Scene``.
    """
    s = Scene()
    number = {name: value.tolist() for name, value in given.items() if name not in ("rest", "centers", "shape")}
    youngs, ratio, steps = number["youngs_modulus"], number["poissons_ratio"], int(number["substeps"])
    s.mu, s.lam = youngs / (2.0 * (1.0 + ratio)), youngs * ratio / ((1.0 + ratio) * (1.0 - 2.0 * ratio))
    s.dt, s.mass = number["control_dt"] / steps, number["density"] * number["volume"]
    for name in ("origin", "low", "high"):
        setattr(s, name, wp.vec3(*number[name]))
    for name in ("dx", "volume", "yield_stress", "gravity", "floor", "radius", "half_length", "friction"):
        setattr(s, name, number[name])
    count, shape = len(given["rest"]), tuple(int(n) for n in given["shape"])
    x = wp.array(given["rest"].astype(np.float32), dtype=wp.vec3, device="cpu")
    v, C = wp.zeros(count, dtype=wp.vec3, device="cpu"), wp.zeros(count, dtype=wp.mat33, device="cpu")
    F = wp.array(np.tile(np.eye(3, dtype=np.float32), (count, 1, 1)), dtype=wp.mat33, device="cpu")
    stress = wp.zeros(count, dtype=wp.mat33, device="cpu")
    momentum, mass = wp.zeros(shape, dtype=wp.vec3, device="cpu"), wp.zeros(shape, dtype=float, device="cpu")
    frames = [x.numpy().copy()]
    for start, end in zip(given["centers"][:-1], given["centers"][1:], strict=True):
        tool = wp.vec3(*((end - start) / number["control_dt"]))
        for n in range(steps):
            momentum.zero_()
            mass.zero_()
            center = wp.vec3(*(start + (end - start) * n / steps))
            wp.launch(stretch, count, inputs=[s, C, F, stress], device="cpu")
            wp.launch(scatter, count, inputs=[s, x, v, C, stress, momentum, mass], device="cpu")
            wp.launch(contact, shape, inputs=[s, center, tool, momentum, mass], device="cpu")
            wp.launch(gather, count, inputs=[s, momentum, x, v, C], device="cpu")
        frames.append(x.numpy().copy())
    return np.stack(frames)


if __name__ == "__main__":
    with np.load(sys.argv[1]) as file:
        np.savez(sys.argv[2], x=simulate(dict(file)))
