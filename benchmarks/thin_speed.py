"""A sheet that falls on a sphere, through rewax and through Warp's semi-implicit cloth in Newton, in turns.

    python benchmarks/thin_speed.py --newton PYTHON     # a Python that has newton and warp-lang
    python benchmarks/thin_speed.py --newton PYTHON --sizes 1000 --turns 3

Every worker has a process of its own and compiles first; then they run in turns, so that what else runs counts for all.
Printed are milliseconds of wall time and of processor time for each substep, the best of the turns, and their ratios to
Newton's. ``thin_scene.py`` is the scene, ``thin_newton.py`` the opponent. Workers:

    newton, newton self      SolverSemiImplicit; with its contact of the cloth with itself, all pairs of triangles and
                             vertices, at 1000 triangles
    hinges, plate            rewax with the same law of bending as Newton's, and with its default
    self                     hinges and contact of the cloth with itself

The last lines are gradients beside central differences of the same program: of the mean height by the sphere's height
(``sphere``), and of the mean x of a flat sheet that lands on a floor by a velocity along x (``slide``).
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import thin_scene as numbers

HERE = Path(__file__).resolve().parent
SUBSTEPS = 64
LONG = 400
"""Substeps of the gradients beside differences."""
WORKERS = ("newton", "hinges", "plate", "self", "newton self")


class Rewax:
    """The worker of rewax."""

    def __init__(self, num_triangles: int, kind: str) -> None:
        import jax
        import jax.numpy as jnp

        from rewax.physics import thin
        from rewax.physics.contact.colliders import Collider
        from rewax.physics.contact.penalty import Ground, PenaltyContact
        from rewax.physics.shapes import Sphere
        from rewax.training import enable_compilation_cache

        enable_compilation_cache()
        (nx, nz), a, touch = numbers.CELLS[num_triangles], numbers.cell(num_triangles), numbers.contact(num_triangles)
        friction = touch.pop("friction")
        law = thin.SelfContact(
            thickness=0.2 * a, stiffness=5.0 * touch["stiffness"], damping=touch["damping"], friction=friction,
            friction_damping=touch["friction_damping"], max_speed=0.5, every=8,
        )  # fmt: skip
        k = numbers.STIFFNESS
        cloth = thin.Cloth(
            warp=3 * k, weft=3 * k, coupling=k, shear=k, bending=numbers.BENDING, density=numbers.DENSITY
        )
        self.thin, self.ground = thin, Ground(normal=(0.0, 1.0, 0.0), height=numbers.RADIUS)
        self.scene = thin.make_scene(
            mesh=thin.sheet(nx * a, nz * a, nx, nz), dt=numbers.DT, cloth=cloth, gravity=(0.0, numbers.GRAVITY, 0.0),
            contact=PenaltyContact(**touch, radius=numbers.TOUCH),
            colliders=(Collider(shape=Sphere(radius=numbers.RADIUS), friction=friction),),
            bending_law=thin.BendingLaw.PLATE if kind == "plate" else thin.BendingLaw.HINGES,
            self_contact=law if kind == "self" else None,
        )  # fmt: skip
        self.x, self.v = map(jnp.asarray, numbers.start(num_triangles))
        self.flat = jnp.asarray(numbers.start(num_triangles, flat=True)[0])

        def height(v: Any, x: Any, lift: Any, count: int) -> Any:
            scene = self.scene
            moved = scene.colliders[0].replace(offset=jnp.array([0.0, 1.0, 0.0]) * lift)
            state = thin.initial_state(x).replace(v=v)
            end = thin.step(scene.replace(colliders=(moved,)), state, thin.static_poses(count, 1))
            return jnp.mean(end.x[:, 1])

        def drift(push: Any, count: int) -> Any:
            """Mean x of a flat sheet that lands on a floor."""
            law = self.scene.contact.replace(friction=friction)
            scene = self.scene.replace(colliders=(), ground=self.ground, contact=law)
            v = jnp.stack([push, numbers.SPEED, 0.0]) + jnp.zeros_like(self.flat)
            end = thin.step(scene, thin.initial_state(self.flat).replace(v=v), thin.static_poses(count, 1))
            return jnp.mean(end.x[:, 0] - self.flat[:, 0])

        self.height = jax.jit(height, static_argnums=3)
        self.slope = jax.jit(jax.value_and_grad(height), static_argnums=3)
        self.by_sphere = jax.jit(jax.grad(height, argnums=2), static_argnums=3)
        self.drift = jax.jit(drift, static_argnums=1)
        self.by_push = jax.jit(jax.grad(drift), static_argnums=1)

    def forward(self, count: int) -> dict:
        return {"height": float(self.height(self.v, self.x, 0.0, count))}

    def backward(self, count: int) -> dict:
        height, slope = self.slope(self.v, self.x, 0.0, count)
        return {"height": float(height), "gradient": [float(g) for g in slope.sum(axis=0)]}

    def sphere(self, count: int) -> dict:
        h = numbers.STEP
        ends = [float(self.height(self.v, self.x, sign * h, count)) for sign in (1.0, -1.0)]
        gradient = float(self.by_sphere(self.v, self.x, 0.0, count))
        return {"gradient": gradient, "difference": (ends[0] - ends[1]) / (2.0 * h)}

    def slide(self, count: int) -> dict:
        h = numbers.STEP
        ends = [float(self.drift(sign * h, count)) for sign in (1.0, -1.0)]
        return {"gradient": float(self.by_push(0.0, count)), "difference": (ends[0] - ends[1]) / (2.0 * h)}


def started(kind: str, size: int, newton: str) -> subprocess.Popen:
    command = [sys.executable, __file__, "--worker", kind, "--sizes", str(size)]
    if kind.startswith("newton"):
        command = [newton, str(HERE / "thin_newton.py"), str(size), *kind.split()[1:]]
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )


def asked(process: subprocess.Popen, operation: str, count: int) -> dict[str, Any]:
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(f"{operation} {count}\n")
    process.stdin.flush()
    for line in process.stdout:
        if line.startswith("{"):
            return json.loads(line)
    return {"error": "the worker has ended"}


def has_newton(python: str) -> bool:
    """Whether this Python can import what the opponent needs."""
    try:
        return subprocess.run([python, "-c", "import newton, warp"], capture_output=True).returncode == 0
    except OSError:
        return False


def compare(size: int, args: argparse.Namespace) -> None:
    kinds = [kind for kind in WORKERS if size == 1000 or kind != "newton self"]
    workers = {kind: started(kind, size, args.newton) for kind in kinds}
    for operation in ("forward", "backward"):
        first = {kind: asked(worker, operation, SUBSTEPS) for kind, worker in workers.items()}
        found: dict[str, list[dict]] = {kind: [] for kind in kinds if "error" not in first[kind]}
        for _ in range(args.turns):
            for kind, answers in found.items():
                answers.append(asked(workers[kind], operation, SUBSTEPS))
        best = {
            kind: [1e3 / SUBSTEPS * min(a[name] for a in answers) for name in ("seconds", "processor")]
            for kind, answers in found.items()
        }
        for kind in kinds:
            if kind not in best:
                print(f"| {size} | {operation} | {kind} | {first[kind]['error']} |", flush=True)
                continue
            ratios = (f"{b / a:.2f}" for a, b in zip(best[kind], best["newton"], strict=True))
            wall, processor = best[kind]
            told = {name: first[kind].get(name) for name in ("height", "gradient")}
            print(
                f"| {size} | {operation} | {kind} | {wall:.3f} | {processor:.3f} | {' | '.join(ratios)} | {told} |",
                flush=True,
            )
    if size == 1000:
        for operation in ("sphere", "slide"):
            for kind in ("newton", "hinges"):
                print(f"| {operation} | {kind} | {asked(workers[kind], operation, LONG)} |", flush=True)
    for worker in workers.values():
        worker.stdin.close()
        worker.wait()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--newton", default=sys.executable)
    parser.add_argument("--sizes", type=int, nargs="+", default=[1000, 10000])
    parser.add_argument("--turns", type=int, default=7)
    parser.add_argument("--worker")
    args = parser.parse_args()
    if args.worker:
        numbers.serve(Rewax(args.sizes[0], args.worker))
        return
    if not has_newton(args.newton):
        raise SystemExit(f"{args.newton} has no newton and warp-lang: give --newton a Python that has both")
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    print("| triangles | program | worker | wall [ms] | processor [ms] | ratio | ratio of processor time | result |")
    print("|---|---|---|---|---|---|---|---|")
    for size in args.sizes:
        compare(size, args)


if __name__ == "__main__":
    main()
