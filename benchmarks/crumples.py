"""Self-contact at the documented speed limit: 200 random crumples of a sheet, and 50 overhand knots pulled tight.

    python benchmarks/crumples.py                  # what has no row yet
    python benchmarks/crumples.py --table          # the table of the rows that are there

Each case is driven by shrinking walls, by two held corners that move at random, or by a random velocity field; a knot by
its two ends. Its ``max_speed`` is ``thin.largest_safe_speed``, and it is driven as fast as keeps every vertex below that:
it runs again with another scale until the fastest vertex of the run reaches 0.75 to 1 of the limit. A second run drives
it at 5 times the speed. ``crossing_referee.py`` counts crossings in each frame of 8 substeps; ``check_status`` is asked
every 5 frames, as an environment asks it after each control step.

Columns of the rows: the fastest vertex over the limit, frames in which something has crossed, the same at five times the
speed, and whether ``check_status`` set ``CROSSED`` in each run.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from crossing_referee import ClothReferee, RopeReferee
from crumple_cases import EVERY, Case, crumples, knots, wall_poses
from rows import append, read

from rewax.physics import thin
from rewax.status import Status
from rewax.training import enable_compilation_cache
from rewax.training.storage.description import provenance

SHEETS = {8: 67, 10: 67, 12: 66}
"""Cells along a side, and number of cases."""
KNOTS = {0.5: 10, 0.75: 10, 1.0: 10, 1.2: 10, 1.5: 10}
"""Thickness over the length of a segment, and number of cases."""
BATCH = 12
FRAMES = {"cloth": 150, "rope": 250}
PER_CHECK = 5
SLOWEST = 0.75
"""Fastest vertex over the limit from which a run counts as one at the limit."""
TAUT = 0.02
"""Mean strain of a rope at which its ends are no longer pulled."""
FIELDS = ("case", "group", "kind", "size", "thickness", "max_speed", "scale", "peak", "crossings", "status", "pressed",
          "excess", "peak_5", "crossings_5", "status_5", "commit")  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    out: Path = Path("runs/crumples.csv")
    seed: int = 0
    table: bool = False
    groups: tuple[str, ...] = ()
    """Only these, such as "8" or "0.5"; none: all."""


@jax.jit
def film(scene: Any, state: Any, drive: Any, scale: jax.Array) -> Any:
    """Positions after each frame, the fastest vertex of each over the limit, the status and how many vertices touch."""
    held = scene.topology.held.indices[:, 0]
    step = drive.speed * scale * scene.dt

    def pulled(at: jax.Array, goal: jax.Array) -> jax.Array:
        """The ways of held vertices towards a waypoint, shape (EVERY, num_held, 3)."""
        gap = goal - at
        size = jnp.linalg.norm(gap, axis=-1, keepdims=True)
        way = jnp.minimum(size, step * jnp.arange(1, EVERY + 1)[:, None, None])
        return at + way * gap / jnp.maximum(size, 1e-9)

    def frame(carry: Any, _: Any) -> Any:
        state, wall, goal = carry
        at = state.x[held]
        reached = jnp.all(jnp.linalg.norm(drive.held[goal] - at, axis=-1) < 1e-3 * jnp.abs(drive.held).max())
        goal = jnp.minimum(goal + reached, len(drive.held) - 1)
        pins = pulled(at, drive.held[goal])
        if scene.rope is not None:
            length = jnp.sum(jnp.linalg.norm(jnp.diff(state.x, axis=0), axis=-1))
            pins = jnp.where(length < (1.0 + TAUT) * jnp.sum(scene.rest.length), pins, at)
        distance = jnp.maximum(wall - step * jnp.arange(EVERY + 1), jnp.minimum(drive.walls[1], wall))
        poses = wall_poses(distance) if scene.colliders else thin.static_poses(EVERY, dtype=state.x.dtype)
        state = thin.step(scene, state, poses, pins=pins)
        mean = jnp.sum(scene.mass[:, None] * state.v, axis=0) / jnp.sum(scene.mass)
        peak = jnp.linalg.norm(state.v - mean, axis=-1).max() / scene.self_contact.max_speed
        return (state, distance[-1], goal), (state.x, peak)

    def check(carry: Any, _: Any) -> Any:
        carry, (x, peak) = jax.lax.scan(frame, carry, length=PER_CHECK)
        state = carry[0]
        pressed = jnp.mean(jnp.any(thin.self_contact_force(scene, state) != 0.0, axis=-1))
        return carry, (x, peak, thin.check_status(scene, state), pressed)

    start = state.replace(v=scale * drive.v)
    return jax.lax.scan(check, (start, drive.walls[0], 0), length=FRAMES["cloth" if scene.rope is None else "rope"] // PER_CHECK)[1]


BATCHED = jax.jit(jax.vmap(film))


def run(cases: list[Case], scales: np.ndarray) -> list[dict[str, Any]]:
    """One run of each case."""
    stacked = [jax.tree.map(lambda *a: jnp.stack(a), *(getattr(c, name) for c in cases)) for name in ("scene", "state", "drive")]
    x, peak, status, pressed = (np.asarray(a) for a in BATCHED(*stacked, jnp.asarray(scales, jnp.float32)))
    found = []
    for k, case in enumerate(cases):
        frames = np.concatenate([np.asarray(case.state.x)[None], x[k].reshape(-1, *x.shape[3:])])
        found.append(
            {
                "peak": float(peak[k].max()),
                "status": int(np.bitwise_or.reduce(status[k])),
                "pressed": float(pressed[k].max()),
                "crossings": crossings(case.scene, frames),
                "excess": excess(case, frames[-1]),
            }
        )
    return found


def crossings(scene: Any, frames: np.ndarray) -> int:
    """Frames in which an edge passes through a triangle, or before which segments have passed through each other."""
    if not np.isfinite(frames).all():
        return -1
    if scene.rope is None:
        referee = ClothReferee(scene.topology.triangles.indices)
        return sum(referee.crossings(x) > 0 for x in frames)
    referee = RopeReferee(len(scene.topology.segments))
    return sum(referee.crossings(*pair) > 0 for pair in zip(frames[:-1], frames[1:], strict=True))


def excess(case: Case, x: np.ndarray) -> float | str:
    """Length of a rope that its knot holds, over the thickness; 0 for a straight rope."""
    if case.scene.rope is None:
        return ""
    along = np.linalg.norm(np.diff(x, axis=0), axis=1).sum()
    return float((along - np.linalg.norm(x[-1] - x[0])) / case.about["thickness"])


def measure(cases: list[Case], names: list[str], args: Args) -> None:
    scales = np.full(len(cases), 0.35 if cases[0].scene.rope is None else 1.0)
    best: list[dict[str, Any] | None] = [None] * len(cases)
    worst = np.zeros(len(cases), int)
    for _ in range(4):
        for k, row in enumerate(run(cases, scales)):
            slow = row["peak"] <= 1.0
            if slow or row["crossings"] < 0:
                worst[k] = max(worst[k], row["crossings"], key=abs)
            if slow and (best[k] is None or row["peak"] > best[k]["peak"]):
                best[k] = {**row, "scale": scales[k]}
            scales[k] *= 1.0 if SLOWEST <= row["peak"] <= 1.0 else np.clip(0.9 / row["peak"], 0.4, 1.6)
        if all(b is not None and b["peak"] >= SLOWEST for b in best):
            break
    final = np.array([1.0 if b is None else b["scale"] for b in best])
    fast = run(cases, 5.0 * final)
    rows = []
    for k, (case, row, other) in enumerate(zip(cases, best, fast, strict=True)):
        row = row or {name: "" for name in ("peak", "status", "pressed", "excess", "scale")}
        beyond = {f"{name}_5": other[name] for name in ("peak", "crossings", "status")}
        about = {**case.about, "case": names[k], "commit": provenance()["commit"]}
        rows.append({**about, **row, "crossings": worst[k], **beyond})
    append(rows, FIELDS, args.out)
    print("\n".join(str({k: r[k] for k in FIELDS[:-1]}) for r in rows), flush=True)


def table(rows: list[dict[str, str]]) -> None:
    print("| cases | number | fastest vertex over the limit | crossed | unreported | 5 times: crossed | unreported |")
    print("|---|---|---|---|---|---|---|")
    for kind in ("walls", "corners", "throw", "knot"):
        own = [r for r in rows if r["kind"] == kind and r["peak"]]
        crossed, beyond = ([r for r in own if int(r[f"crossings{s}"]) != 0] for s in ("", "_5"))
        silent = [sum(not int(r[f"status{s}"]) & Status.CROSSED for r in rs) for s, rs in (("", crossed), ("_5", beyond))]
        peaks = [float(r["peak"]) for r in own] or [0.0]
        print(
            f"| {kind} | {len(own)} | {min(peaks):.2f} to {max(peaks):.2f}, median {np.median(peaks):.2f} | "
            f"{len(crossed)} | {silent[0]} | {len(beyond)} | {silent[1]} |"
        )


def main(args: Args) -> None:
    if args.table:
        return table(read(args.out))
    enable_compilation_cache()
    groups = [(f"{n}", n, count, crumples) for n, count in SHEETS.items()]
    groups += [(f"{d}", d, count, knots) for d, count in KNOTS.items()]
    done = {row["case"] for row in read(args.out)}
    for name, size, count, draw in groups:
        names = [f"{name}-{args.seed}-{k}" for k in range(count)]
        if (args.groups and name not in args.groups) or done.issuperset(names):
            continue
        cases = draw(size, count, args.seed)
        # Batches of one length share a program; the last one begins earlier and its first rows are not kept twice.
        for start in range(0, count, BATCH):
            at = range(max(0, min(start, count - BATCH)), min(start + BATCH, count))
            left = [k for k in at if names[k] not in done]
            if left:
                measure([cases[k] for k in at], [names[k] for k in at], args)
                done.update(names[k] for k in at)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
