"""``rewax.identify`` on records from another simulator: a body and a pin in NVIDIA Warp, pushed before a camera.

    python -m venv opponents && opponents/bin/pip install warp-lang numpy
    python benchmarks/identify_other_world.py --python opponents/bin/python --cases 3
    python benchmarks/identify_other_world.py --report

The pushes, the priors, the true numbers, the camera's noise, the occlusion and the grids of the fits are those of
``identify_cases.py``. The record comes from ``identify_in_warp.py``, with 64 cells a metre and eight particles in each,
at random places. Its elastic block is fixed corotated, and so is that of the fits. Its pin acts on the nodes inside of
it, whereas a pin of rewax acts on nodes up to a cell away. ``--gaps`` measures what that changes, and a pin of the fits
that is 5 mm thinner makes up for it (``--thinner 0.005``). Rows are those of ``docs/suites/identify/other_world.csv``.
A second call goes on where the first stopped, with the records that it finds in ``--records``.
"""

import argparse
import dataclasses
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import identify_cases as cases
import jax
import jax.numpy as jnp
import numpy as np
import rows as stored
from identify_worlds import FLOOR, KINDS, RADIUS, Kind, world

from rewax.identify import Record, load, record_states, save
from rewax.identify.simulate import without_reset_noise
from rewax.identify.unknowns import space_of
from rewax.physics import mpm
from rewax.training import enable_compilation_cache

RESULTS = cases.RESULTS.with_name("other_world.csv")
CELLS = 64
COURANT = 0.3
"""Of elastic waves in Warp's substeps."""
_STIFF = {"elastic": mpm.FixedCorotated(youngs_modulus=200.0, poissons_ratio=0.3)}


def kind_of(name: str) -> Kind:
    """The kind with the elasticity of the Warp world."""
    kind = KINDS[name]
    elasticity = _STIFF.get(name, kind.material.elasticity)
    return dataclasses.replace(kind, material=kind.material.replace(elasticity=elasticity))


def real_world(kind: Kind, case: int) -> Any:
    """An environment with the particles, the grid and the numbers of the Warp world; it shows what a camera sees."""
    env = world(kind, CELLS, 0.5 / CELLS, shake=0.9, seed=case)
    space = space_of(kind.priors, env)
    return without_reset_noise(space.place(env, cases.latent_of(space, kind.truth(case))))


def warp_states(env: Any, actions: np.ndarray, python: str) -> list[Any]:
    """The ``physics`` of an environment before the first action and after each, with particles that Warp moved."""
    state = jax.jit(env.reset)(jax.random.key(0))
    joints = [np.asarray(state.physics.joint_q)]
    for action in actions:
        moved = joints[-1] + action * np.asarray(env.joint_step)
        joints.append(np.clip(moved, np.asarray(env.joint_lower), np.asarray(env.joint_upper)))
    path = np.stack(joints)
    if np.ptp(path[:, 2]):
        raise ValueError("the pin of the Warp world does not turn: give actions without yaw")
    scene, material = env.scene, env.scene.material
    mu, lam = (float(m) for m in material.elasticity.moduli())
    speed = np.sqrt((lam + 2.0 * mu) / float(material.density))
    plasticity = material.plasticity
    given = {
        "rest": np.asarray(env.rest_positions), "centers": np.asarray(env.poses(jnp.asarray(path)).position[:, 0]),
        "shape": scene.grid.shape, "origin": scene.grid.origin, "dx": scene.grid.spacing, "control_dt": env.control_dt,
        "substeps": int(np.ceil(env.control_dt * speed / (COURANT * scene.grid.spacing))), "density": material.density,
        "volume": scene.particle_volume, "youngs_modulus": material.elasticity.youngs_modulus,
        "poissons_ratio": material.elasticity.poissons_ratio, "gravity": -scene.gravity[1], "floor": FLOOR,
        "yield_stress": 0.0 if plasticity is None else plasticity.yield_stress, "radius": RADIUS,
        "low": [wall.position if wall else 0.0 for wall in scene.walls.lower],
        "high": [wall.position if wall else 1.0 for wall in scene.walls.upper],
        "half_length": scene.colliders[0].shape.half_length, "friction": scene.colliders[0].friction,
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        files = [str(Path(folder) / name) for name in ("scene.npz", "particles.npz")]
        np.savez(files[0], **given)
        subprocess.run([python, "-I", str(Path(__file__).with_name("identify_in_warp.py")), *files], check=True)
        frames = np.load(files[1])["x"]
    if not np.isfinite(frames).all():
        raise ValueError("the Warp world is unstable: take a smaller COURANT")
    at = state.physics
    return [
        at.replace(soft=at.soft.replace(x=jnp.asarray(x)), joint_q=jnp.asarray(q, jnp.float32))
        for x, q in zip(frames, path, strict=True)
    ]


def seen(env: Any, name: str, case: int, args: argparse.Namespace) -> tuple[Record, Record]:
    """The push that is fitted, with noise and occlusion, and the one that is held out."""
    found = []
    for label, hidden in (("push", {"noise": cases.NOISE, "occlusion": cases.OCCLUSION}), ("held_out", {})):
        path = args.records / f"{name}_{case}_{label}.npz"
        if not path.is_file():
            actions = KINDS[name].actions(label == "held_out")
            states, key = warp_states(env, actions, args.python), jax.random.key(case)
            made = record_states(env, states, actions, key, every=2, num_points=cases.POINTS, source="Warp", **hidden)
            save(made, path)
        found.append(load(path))
    return found[0], found[1]


def gaps(kind: Kind, case: int, python: str) -> str:
    """How far particles stay from the pin, in Warp and in rewax on several grids, all with the true numbers."""
    env, actions = real_world(kind, case), kind.actions()
    lines = [f"Warp, {CELLS} cells: {_gap(env, warp_states(env, actions, python))}"]
    for cells in (24, 36, CELLS):
        own = world(kind, cells, 0.5 / cells, shake=0.9, seed=case)
        space = space_of(kind.priors, own)
        own = without_reset_noise(space.place(own, cases.latent_of(space, kind.truth(case))))
        state, states = jax.jit(own.reset)(jax.random.key(0)), []
        for action in [None, *actions]:
            state = state if action is None else _step(own, state, jnp.asarray(action))
            states.append(state.physics)
        lines.append(f"rewax, {cells} cells: {_gap(own, states)}")
    return "\n".join(lines)


@jax.jit
def _step(env: Any, state: Any, action: jax.Array) -> Any:
    return env.step(state, action)


def _gap(env: Any, states: list[Any]) -> str:
    """Of the surface: half a spacing of the particles nearer than the nearest twenty, at the deepest state."""
    deepest = min(states, key=lambda physics: float(physics.joint_q[1]))
    arm = np.asarray(deepest.soft.x) - np.asarray(env.poses(deepest.joint_q[None]).position[0, 0])
    distance = np.sort(np.linalg.norm(arm[:, :2], axis=1))[:20].mean() - RADIUS
    dx = float(env.scene.grid.spacing)
    gap = distance - 0.25 * dx
    return f"{1e3 * gap:.1f} mm, {gap / dx:.2f} cells"


def report(rows: list[dict[str, str]]) -> str:
    """Two tables: the numbers of each case, and how well its second push is predicted."""
    lines = ["| world | unknown | true | found, 95 % interval | of the finest grid alone |", "|---|---|---|---|---|"]
    for row in rows:
        numbers = {name: f"{float(row[name]):.4g}" for name in ("true", "found", "low", "high", "finest")}
        found = "{found}, {low} to {high} | {finest}".format(**numbers)
        lines.append(f"| {row['kind']}, case {row['case']} | {row['unknown']} | {numbers['true']} | {found} |")
    lines += [
        "", "| world | residual of the fit | held-out push: identified | of the finest grid alone | prior's median "
        "| true numbers |", "|---|---|---|---|---|---|",
    ]  # fmt: skip
    columns = ("residual_mm", "held_out_mm", "held_out_finest_mm", "held_out_prior_mm", "held_out_true_mm")
    for row in {(row["kind"], row["case"]): row for row in rows}.values():
        distances = " | ".join(f"{float(row[c]):.1f} mm" if row.get(c) else "-" for c in columns)
        lines.append(f"| {row['kind']}, case {row['case']} | {distances} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", default="python", help="interpreter that has Warp")
    parser.add_argument("--cases", type=int, default=3, help="of each kind")
    parser.add_argument("--kinds", nargs="+", default=["elastic", "dough"], choices=["elastic", "dough"])
    parser.add_argument("--out", type=Path, default=RESULTS)
    parser.add_argument("--records", type=Path, default=Path("identify_records"))
    parser.add_argument("--thinner", type=float, default=0.0, help="what the fits' pin lacks in radius [m]")
    parser.add_argument("--report", action="store_true")
    parser.add_argument("--gaps", action="store_true")
    parser.add_argument("--verbose", action="store_true")
    args = parser.parse_args()
    if args.report:
        print(report(stored.read(args.out)))
        return
    enable_compilation_cache()
    done = {(row["kind"], int(row["case"])) for row in stored.read(args.out)}
    for case in range(args.cases):
        for name in args.kinds:
            kind = kind_of(name)
            if args.gaps:
                print(f"{name} {case}\n{gaps(kind, case, args.python)}", flush=True)
                continue
            label = f"{name}, pin {1e3 * args.thinner:g} mm thinner" if args.thinner else name
            if (label, case) in done:
                continue
            fits = [world(kind, *grid, thinner=args.thinner) for grid in (cases.COARSE, cases.FINE)]
            records = seen(real_world(kind, case), name, case, args)
            rows = cases.rows_of(kind, (label, case), fits, records, limit=1.0 / CELLS, verbose=args.verbose)
            stored.append(rows, cases.COLUMNS, args.out)
            for r in rows:
                said = f"{label} {case} {r['unknown']}: true {r['true']}, found {r['found']} [{r['low']}, {r['high']}]"
                print(f"{said}, {r['seconds']} s", flush=True)


if __name__ == "__main__":
    main()
