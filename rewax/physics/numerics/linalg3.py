"""Spectral functions, polar decomposition and singular value decomposition (SVD) of 3x3 matrices.

LAPACK costs about 1.3 microseconds per matrix, the vectorised Jacobi iteration here about twenty times less. The
derivative of an SVD is 0/0 at repeated singular values, and every particle starts there (F = I). Isotropic functions
of a symmetric matrix have finite derivatives: with b = U diag(lambda) U^T the derivative of U diag(f(lambda)) U^T is
U (K o (U^T db U)) U^T with the divided differences K_ij = (f_i - f_j) / (lambda_i - lambda_j). Where eigenvalues meet,
K tends to a derivative (Daleckii and Krein). ``divided_differences`` computes K for any gap.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rewax.lowering.fusion import materialize
from rewax.lowering.linear_primitive import Arrays, ByPlatform, linear_call, no_transpose
from rewax.lowering.structural import structural_zeros
from rewax.physics.numerics import components as cp
from rewax.physics.numerics import divided_differences as dd
from rewax.physics.numerics.components import AXES, Mat3, Vec3
from rewax.physics.numerics.divided_differences import Principal
from rewax.types import Array

SpectralFunction = Callable[[Principal, Any], tuple[Principal | Array, ...]]
"""``(eigenvalues, parameters) -> results``, composed of operations of ``divided_differences``.

A result is a ``Principal``, or one array if it is the same on all axes. The function must be equivariant under
permutations of the axes. It returns divided differences if the eigenvalues have them.
"""

_ROTATIONS = ((0, 1), (0, 2), (1, 2))


def _num_sweeps(dtype) -> int:
    return 5 if jnp.finfo(dtype).bits >= 64 else 4


def eigh_components(a: Mat3) -> tuple[Vec3, Mat3]:
    """Eigenvalues (unordered) and eigenvectors (columns) of symmetric matrices given by components.

    Cyclic Jacobi rotations: four sweeps in float32 and five in float64 reach rounding accuracy.
    Gradient: none, an error (use ``spectral`` for functions of the eigenvalues).
    Source: Golub and Van Loan, Matrix Computations, 8.5.
    """
    rows = tuple(jnp.asarray(component) for row in a for component in row)
    out = linear_call(_SWEEPS, no_transpose, None, rows, (), like=[*rows[:3], *rows])
    return (out[0], out[1], out[2]), (out[3:6], out[6:9], out[9:12])  # type: ignore[return-value]


def _sweeps(static: None, residuals: Arrays, linear: Arrays, *, unroll: bool) -> Arrays:
    """Eigenvalues and eigenvectors, 3 + 9 components, of matrices by their 9 components."""
    del static, linear
    one, zero = jnp.ones_like(residuals[0]), jnp.zeros_like(residuals[0])
    a = (residuals[:3], residuals[3:6], residuals[6:])
    identity = cp.matrix(lambda i, j: one if i == j else zero)
    s, u = jax.lax.fori_loop(
        0, _num_sweeps(one.dtype), lambda _, carry: _sweep(*carry), (a, identity), unroll=True if unroll else None
    )
    return (s[0][0], s[1][1], s[2][2], *u[0], *u[1], *u[2])


# On a CPU a loop compiles faster, and XLA cannot recompute one sweep inside the next. On a GPU each iteration of a loop
# would launch its own kernels and copies; unrolled sweeps are one kernel.
_SWEEPS = ByPlatform(cpu=functools.partial(_sweeps, unroll=False), other=functools.partial(_sweeps, unroll=True))


def _sweep(a: Mat3, eigenvectors: Mat3) -> tuple[Mat3, Mat3]:
    """One cyclic sweep of three Jacobi rotations of a symmetric matrix, and of the eigenvectors gathered so far."""
    s, u = [list(row) for row in a], [list(row) for row in eigenvectors]
    tiny = float(jnp.finfo(a[0][0].dtype).tiny)
    for p, q in _ROTATIONS:
        r = 3 - p - q
        difference = s[q][q] - s[p][p]
        twice = 2.0 * s[p][q]
        # Squares can underflow: without the maximum t explodes and mixes equal eigenvalues.
        root = jnp.maximum(jnp.sqrt(difference * difference + twice * twice), jnp.abs(twice))
        t = twice * jnp.where(difference >= 0, 1.0, -1.0) / (jnp.abs(difference) + root + tiny)
        cosine = jax.lax.rsqrt(1.0 + t * t)
        sine = t * cosine
        s[p][p], s[q][q] = s[p][p] - t * s[p][q], s[q][q] + t * s[p][q]
        s[p][q] = s[q][p] = jnp.zeros_like(t)
        rp, rq = s[r][p], s[r][q]
        s[r][p] = s[p][r] = cosine * rp - sine * rq
        s[r][q] = s[q][r] = sine * rp + cosine * rq
        for row in u:
            row[p], row[q] = cosine * row[p] - sine * row[q], sine * row[p] + cosine * row[q]
    return cp.matrix(lambda i, j: s[i][j]), cp.matrix(lambda i, j: u[i][j])


def _recompose(u: Mat3, principal: Vec3) -> Mat3:
    """U diag(principal) U^T."""
    upper = {(i, j): sum(u[i][k] * principal[k] * u[j][k] for k in AXES) for i in AXES for j in AXES if i <= j}
    return cp.matrix(lambda i, j: upper[min(i, j), max(i, j)])


def _symmetric_product(a: Mat3, b: Mat3) -> Mat3:
    """The product a b, known to be symmetric."""
    upper = {(i, j): sum(a[i][k] * b[k][j] for k in AXES) for i in AXES for j in AXES if i <= j}
    return cp.matrix(lambda i, j: upper[min(i, j), max(i, j)])


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def spectral(function: SpectralFunction, b: Mat3, parameters: Any) -> tuple[Any, ...]:
    """Isotropic tensor functions U diag(f(lambda)) U^T of symmetric matrices b = U diag(lambda) U^T.

    Args:
      function: ``(eigenvalues, parameters) -> (f, g, ...)``, each a ``Principal`` or one array. f_i may depend on all
        eigenvalues. Permuting the eigenvalues must permute a ``Principal`` the same way and leave an array unchanged.
      b: symmetric matrices by components of any shape.
      parameters: pytree of arrays that broadcast against the components.

    Returns:
      One symmetric matrix, by components, for each ``Principal``; arrays unchanged.

    Gradient: exact with respect to b and parameters, forward and reverse, finite at repeated eigenvalues.
    Source: Daleckii and Krein 1965; Miehe 1998, "Comparison of two algorithms for the computation of fourth-order
      isotropic tensor functions". Deviation: close eigenvalues use the chain rule of divided differences, no limit.
    """
    eigenvalues, u = eigh_components(b)
    found = function(Principal(eigenvalues), parameters)
    return tuple(_recompose(u, f.values) if isinstance(f, Principal) else f for f in found)


def _is_zero(tangent) -> bool:
    return isinstance(tangent, jax.custom_derivatives.SymbolicZero)


def _instantiate(tangents):
    """Replace symbolic zeros by arrays of zeros."""
    return jax.tree.map(lambda t: jnp.zeros(t.shape, t.dtype) if _is_zero(t) else t, tangents, is_leaf=_is_zero)


def _spectral_jvp(function: SpectralFunction, primals, tangents):
    b, parameters = primals
    db, dparameters = _instantiate(tangents[0]), tangents[1]
    parameters_move = not all(_is_zero(t) for t in jax.tree.leaves(dparameters, is_leaf=_is_zero))
    eigenvalues, u = eigh_components(b)
    principal = materialize(function(dd.eigenvalues(eigenvalues), parameters))
    one, zero = jnp.ones_like(eigenvalues[0]), jnp.zeros_like(eigenvalues[0])

    def values(eigenvalues: Vec3, parameters: Any) -> tuple[Vec3 | tuple[Array], ...]:
        found = function(Principal(eigenvalues), parameters)
        return tuple(f.values if isinstance(f, Principal) else (f,) for f in found)

    # by_eigenvalue[j][n][i]: derivative of component i of result n by eigenvalue j
    axes = structural_zeros([cp.vector(lambda i, j=j: one if i == j else zero) for j in AXES])
    by_eigenvalue = materialize([jax.jvp(lambda e: values(e, parameters), (eigenvalues,), (a,))[1] for a in axes])
    by_parameters = None
    if parameters_move:
        _, by_parameters = jax.jvp(lambda p: values(eigenvalues, p), (parameters,), (_instantiate(dparameters),))
    symmetric = materialize(cp.matmul(cp.matrix(lambda i, j: 0.5 * (db[i][j] + db[j][i])), u))
    rotated = materialize(_symmetric_product(cp.transpose(u), symmetric))

    def slope(n: int, i: int) -> Array:
        """Derivative of component i of result n along the diagonal, and by parameters."""
        along = cp.dot(cp.vector(lambda a: by_eigenvalue[a][n][i]), cp.vector(lambda a: rotated[a][a]))
        return along if by_parameters is None else along + by_parameters[n][i]

    out, dout = [], []
    for n, f in enumerate(principal):
        if not isinstance(f, Principal):
            out.append(f)
            dout.append(slope(n, 0))
            continue

        def entry(i: int, j: int, differences=f.differences, n=n) -> Array:
            return differences[3 - i - j] * rotated[i][j] if i != j else slope(n, i)  # pyright: ignore[reportOptionalSubscript]

        half = materialize(cp.matmul(materialize(cp.matrix(entry)), cp.transpose(u)))
        out.append(_recompose(u, f.values))
        dout.append(_symmetric_product(u, half))
    return tuple(out), tuple(dout)


spectral.defjvp(_spectral_jvp, symbolic_zeros=True)


def polar_components(f: Mat3) -> Mat3:
    """Rotation R of the polar decomposition F = V R, by components: b^(-1/2) F with b = F F^T.

    Singular values below 1e-6 of the largest count as 1e-6 of it, so the result stays finite for flattened matrices,
    where it is not a rotation. For inverted ones (det F < 0) R is the orthogonal factor with determinant -1.
    Gradient: exact for regular F, finite everywhere.
    """

    def inverse_root(eigenvalues: Principal, parameters: None) -> tuple[Principal, ...]:
        del parameters
        a, b, c = eigenvalues.values
        largest = jnp.maximum(jnp.maximum(a, b), c)
        # tiny^0.6 keeps the derivative, floor^(-3/2), finite for a zero matrix.
        floor = jax.lax.stop_gradient(jnp.maximum(1e-12 * largest, float(jnp.finfo(largest.dtype).tiny) ** 0.6))
        return (dd.reciprocal(dd.sqrt(dd.maximum(eigenvalues, floor))),)

    (root,) = spectral(inverse_root, cp.matmul(f, cp.transpose(f)), None)
    return cp.matmul(root, f)


def eigh(a: Array) -> tuple[Array, Array]:
    """Eigenvalues, ascending, and eigenvectors of symmetric matrices.

    Args:
      a: symmetric, shape (..., 3, 3).

    Returns:
      Eigenvalues of shape (..., 3) and eigenvectors as columns of shape (..., 3, 3).

    Gradient: exact and always finite. The eigenvectors' rotation within (nearly) repeated eigenvalues has no
      derivative: that part is cut.
    """
    return _eigh(a)


@jax.custom_jvp
def _eigh(a: Array) -> tuple[Array, Array]:
    eigenvalues, u = eigh_components(cp.split_matrix(a))
    values, vectors = cp.join_vector(eigenvalues), cp.join_matrix(u)
    order = jnp.argsort(values, axis=-1)
    return jnp.take_along_axis(values, order, axis=-1), jnp.take_along_axis(vectors, order[..., None, :], axis=-1)


@_eigh.defjvp
def _eigh_jvp(primals, tangents):
    (a,), (da,) = primals, tangents
    values, u = _eigh(a)
    rotated = _matmul(_matmul(_transpose(u), 0.5 * (da + _transpose(da))), u)
    dvalues = jnp.diagonal(rotated, axis1=-2, axis2=-1)
    turn = rotated * _guarded_inverse(values[..., None, :] - values[..., :, None], values)
    return (values, u), (dvalues, _matmul(u, turn))


def svd(a: Array) -> tuple[Array, Array, Array]:
    """Singular value decomposition A = U diag(S) V^T with rotations U and V.

    Args:
      a: matrices, shape (..., 3, 3).

    Returns:
      U (..., 3, 3), S (..., 3) descending in magnitude, V^T (..., 3, 3). det U = det V = 1, so the smallest singular
      value carries the sign of det A (inverted elements).

    Gradient: exact for S and always finite. U and V are exact where singular values are distinct; their rotation within
      (nearly) repeated ones has no derivative, and that part is cut. Laws that need only b = F F^T should use
      ``spectral``, which is exact everywhere.
    Source: Papadopoulo and Lourakis 2000, "Estimating the Jacobian of the SVD".
    """
    u, s, v = _svd(a)
    return u, s, _transpose(v)


@jax.custom_jvp
def _svd(a: Array) -> tuple[Array, Array, Array]:
    _, v = _eigh(_matmul(_transpose(a), a))
    v = v[..., ::-1]
    v = v.at[..., 2].set(jnp.cross(v[..., 0], v[..., 1]))
    av = _matmul(a, v)
    u0, n0 = _unit(av[..., 0], jnp.array([1.0, 0.0, 0.0], a.dtype))
    across = av[..., 1] - jnp.sum(av[..., 1] * u0, -1, keepdims=True) * u0
    u1, _ = _unit(across, _any_orthogonal(u0), relative_to=n0)
    u = jnp.stack([u0, u1, jnp.cross(u0, u1)], axis=-1)
    return u, jnp.sum(u * av, axis=-2), v


@_svd.defjvp
def _svd_jvp(primals, tangents):
    (a,), (da,) = primals, tangents
    u, s, v = _svd(a)
    rotated = _matmul(_matmul(_transpose(u), da), v)
    ds = jnp.diagonal(rotated, axis1=-2, axis2=-1)
    si, sj = s[..., :, None], s[..., None, :]
    inverse = _guarded_inverse(sj * sj - si * si, s * s)
    swapped = _transpose(rotated)
    du = _matmul(u, inverse * (rotated * sj + si * swapped))
    dv = _matmul(v, inverse * (si * rotated + swapped * sj))
    return (u, s, v), (du, ds, dv)


def _matmul(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")


def _transpose(a: Array) -> Array:
    return jnp.swapaxes(a, -1, -2)


def _guarded_inverse(gap: Array, values: Array) -> Array:
    """1 / gap, zero where the gap is zero or lost in rounding."""
    eps = jnp.finfo(gap.dtype).eps
    small = jnp.abs(gap) <= 10 * eps * jnp.max(jnp.abs(values), axis=-1)[..., None, None]
    small = small | (gap == 0)
    return jnp.where(small, 0.0, 1.0 / jnp.where(small, 1.0, gap))


def _unit(a: Array, fallback: Array, relative_to: Array | None = None) -> tuple[Array, Array]:
    """a / |a| and |a|. Where |a| is zero, or rounding error relative to a length, the direction is the fallback."""
    length = jnp.sqrt(jnp.sum(a * a, -1, keepdims=True))
    reference = 0.0 if relative_to is None else relative_to
    lost = length <= jnp.finfo(a.dtype).eps * reference + jnp.finfo(a.dtype).tiny
    return jnp.where(lost, fallback, a / jnp.where(lost, 1.0, length)), length


def _any_orthogonal(a: Array) -> Array:
    """A unit vector orthogonal to the unit vector a."""
    axis = jnp.where(
        jnp.abs(a[..., :1]) < 0.8, jnp.array([1.0, 0.0, 0.0], a.dtype), jnp.array([0.0, 1.0, 0.0], a.dtype)
    )
    c = jnp.cross(a, axis)
    return c / jnp.sqrt(jnp.sum(c * c, -1, keepdims=True))
