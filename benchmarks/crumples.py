"""Self-contact at the documented speed limit: 200 random crumples of a sheet, and 50 overhand knots pulled tight.

    python benchmarks/crumples.py                  # what has no row yet
    python benchmarks/crumples.py --table          # the table of the rows that are there

A sheet starts rolled up or folded in zigzag. It is driven by four walls that close in, by two held corners that move at
random, or by a random velocity field; a knot by its two ends. Its ``max_speed`` is ``thin.largest_safe_speed``. It
runs again with another scale until its fastest vertex reaches 0.6 to 1 of that limit, four times at most, and then once
more at five times that scale. ``crossing_referee.py`` counts crossings in each frame of 8 substeps. ``check_status`` is
asked every 5 frames, as an environment asks it after each control step.

Columns of the rows: the fastest vertex over the limit (``peak``), the number of frames in which something has crossed,
all bits of ``check_status``, the largest share of vertices that touch another layer (``pressed``), and the length that
a knot holds over the rope's thickness (``excess``). Those with ``_5`` are of the run at five times the speed.
"""

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from crossing_referee import ClothReferee, RopeReferee
from crumple_cases import EVERY, KINDS, Batch, Drive, crumples, knots, wall_poses
from rows import append, read

from rewax.physics import thin
from rewax.status import Status
from rewax.training import enable_compilation_cache
from rewax.training.storage.description import provenance

SHEETS = {8: 120, 10: 50, 12: 30}
"""Cells along a side, and number of cases."""
KNOTS = {(0.7, 1.3): 30, (1.35, 1.6): 20}
"""Range of the thickness over the length of a segment, and number of cases."""
BATCH = 20
FRAMES = {"cloth": 100, "rope": 250}
PER_CHECK = 5
SLOWEST = 0.6
"""Fastest vertex over the limit from which a run counts as one at the limit."""
TRIES = 4
START = 15
"""Frames in which walls and held vertices reach their speed."""
TAUT = 0.02
"""Mean strain of a rope at which its ends are no longer pulled."""
FIELDS = ("case", "group", "kind", "cell", "thickness", "max_speed", "scale", "peak", "crossings", "status", "pressed",
          "excess", "peak_5", "crossings_5", "status_5", "commit")  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    out: Path = Path("docs/suites/crumples/results.csv")
    """The file of rows."""
    seed: int = 0
    table: bool = False
    groups: tuple[str, ...] = ()
    """Only these, such as "8 x 8" or "0.7 to 1.3"; none: all."""


@jax.jit
def film(scene: Any, x: jax.Array, drive: Drive, scale: jax.Array) -> Any:
    """Positions after each frame, the fastest vertex of each over the limit, the status and how many vertices touch."""
    held = scene.topology.held.indices[:, 0]
    full_step = drive.speed * scale * scene.dt

    def pulled(at: jax.Array, goal: jax.Array, step: jax.Array) -> jax.Array:
        """The ways of held vertices towards a waypoint, shape (EVERY, num_held, 3)."""
        gap = goal - at
        size = jnp.linalg.norm(gap, axis=-1, keepdims=True)
        way = jnp.minimum(size, step * jnp.arange(1, EVERY + 1)[:, None, None])
        return at + way * gap / jnp.maximum(size, 1e-9)

    def frame(carry: Any, _: Any) -> Any:
        state, wall, goal, ramp = carry
        step = full_step * jnp.minimum(ramp, 1.0)
        at = state.x[held]
        reached = jnp.all(jnp.linalg.norm(drive.held[goal] - at, axis=-1) < 1e-3 * jnp.abs(drive.held).max())
        goal = jnp.minimum(goal + reached, len(drive.held) - 1)
        pins = pulled(at, drive.held[goal], step)
        if scene.rope is not None:
            length = jnp.sum(jnp.linalg.norm(jnp.diff(state.x, axis=0), axis=-1))
            pins = jnp.where(length < (1.0 + TAUT) * jnp.sum(scene.rest.length), pins, at)
        distance = jnp.maximum(wall - step * jnp.arange(EVERY + 1), jnp.minimum(drive.walls[1], wall))
        poses = wall_poses(distance) if scene.colliders else thin.static_poses(EVERY, dtype=state.x.dtype)
        state = thin.step(scene, state, poses, pins=pins)
        mean = jnp.sum(scene.mass[:, None] * state.v, axis=0) / jnp.sum(scene.mass)
        peak = jnp.linalg.norm(state.v - mean, axis=-1).max() / scene.self_contact.max_speed
        return (state, distance[-1], goal, ramp + 1.0 / START), (state.x, peak)

    def check(carry: Any, _: Any) -> Any:
        carry, (x, peak) = jax.lax.scan(frame, carry, length=PER_CHECK)
        state = carry[0]
        pressed = jnp.mean(jnp.any(thin.self_contact_force(scene, state) != 0.0, axis=-1))
        return carry, (x, peak, thin.check_status(scene, state), pressed)

    start = thin.initial_state(x).replace(v=scale * drive.v)
    checks = FRAMES["cloth" if scene.rope is None else "rope"] // PER_CHECK
    return jax.lax.scan(check, (start, drive.walls[0], 0, 1.0 / START), length=checks)[1]


BATCHED = jax.jit(jax.vmap(film))


class Cases:
    """Cases of one batch that wait for a run: first for one at the limit, then for one at five times its speed."""

    def __init__(self, batch: Batch, names: list[str], out: Path) -> None:
        self.batch, self.names, self.out = batch, names, out
        self.is_rope = batch.scene.rope is not None
        topology = batch.scene.topology
        self.cloth = None if self.is_rope else ClothReferee(topology.triangles.indices)
        self.rope = RopeReferee(len(topology.segments)) if self.is_rope else None
        done = {row["case"] for row in read(out)}
        self.scale = {k: 1.0 if self.is_rope else 0.6 for k, name in enumerate(names) if name not in done}
        self.tried: dict[int, list[dict[str, Any]]] = {k: [] for k in self.scale}

    def run(self) -> bool:
        """One run of as many cases as fit; whether any was left."""
        at = list(self.scale)[:BATCH]
        if not at:
            return False
        full = np.resize(at, BATCH)
        chosen = jax.tree.map(lambda a: a[full], (self.batch.scene, self.batch.x, self.batch.drive))
        x, peak, status, pressed = map(
            np.asarray, BATCHED(*chosen, jnp.asarray([self.scale[k] for k in full], jnp.float32))
        )
        for n, k in enumerate(at):
            frames = np.concatenate([self.batch.x[k][None], x[n].reshape(-1, *x.shape[3:])])
            found = {
                "scale": self.scale[k], "peak": float(peak[n].max()), "status": int(np.bitwise_or.reduce(status[n])),
                "pressed": float(pressed[n].max()),
            }  # fmt: skip
            self.judge(k, found, frames)
        return True

    def judge(self, k: int, found: dict[str, Any], frames: np.ndarray) -> None:
        """Write the row, or say at which scale the case runs next."""
        best = next((row for row in self.tried[k] if row.get("last")), None)
        if best is not None:
            beyond = {"peak_5": found["peak"], "status_5": found["status"], "crossings_5": self.crossings(frames)}
            worst = max(row["crossings"] for row in self.tried[k] if row["peak"] <= 1.0)
            own = {**self.batch.rows[k], **best, "crossings": worst, **beyond, "case": self.names[k]}
            row = {name: own.get(name, "") for name in FIELDS} | {"commit": provenance()["commit"]}
            append([row], FIELDS, self.out)
            print({name: row[name] for name in FIELDS[:-1]}, flush=True)
            del self.scale[k]
            return
        if found["peak"] <= 1.0:
            found |= {"crossings": self.crossings(frames), "excess": self.excess(k, frames[-1])}
        self.tried[k].append(found)
        slow = [row for row in self.tried[k] if row["peak"] <= 1.0]
        if slow and (max(row["peak"] for row in slow) >= SLOWEST or len(self.tried[k]) >= TRIES):
            best = max(slow, key=lambda row: row["peak"])
            best["last"] = True
            self.scale[k] = 5.0 * best["scale"]
        else:
            self.scale[k] *= float(np.clip(0.9 / found["peak"], 0.3, 1.6))

    def crossings(self, frames: np.ndarray) -> int:
        """Frames in which an edge passes through a triangle, or before which segments passed through each other."""
        frames = frames[: np.isfinite(frames).all(axis=(1, 2)).argmin() or len(frames)]
        if self.cloth is not None:
            return sum(self.cloth.crossings(x) > 0 for x in frames)
        return sum(self.rope.crossings(*pair) > 0 for pair in itertools.pairwise(frames))

    def excess(self, k: int, x: np.ndarray) -> float | str:
        """Length of a rope that its knot holds, over the thickness; 0 for a straight rope."""
        along = np.linalg.norm(np.diff(x, axis=0), axis=1).sum() - np.linalg.norm(x[-1] - x[0])
        return round(float(along) / float(self.batch.rows[k]["thickness"]), 2) if self.is_rope else ""


def table(rows: list[dict[str, str]]) -> None:
    print(
        "| driven by | cases | fastest vertex over the limit | crossed | unreported | 5 times: crossed | unreported |"
    )
    print("|---|---|---|---|---|---|---|")
    for kind in (*KINDS, "knot"):
        own = [row for row in rows if row["kind"] == kind]
        counts = []
        for suffix in ("", "_5"):
            crossed = [row for row in own if int(row[f"crossings{suffix}"])]
            counts += [len(crossed), sum(not int(row[f"status{suffix}"]) & Status.CROSSED for row in crossed)]
        peaks = [float(row["peak"]) for row in own] or [0.0]
        spread = f"{min(peaks):.2f} to {max(peaks):.2f}, median {np.median(peaks):.2f}"
        print(f"| {kind} | {len(own)} | {spread} | " + " | ".join(map(str, counts)) + " |")


def main(args: Args) -> None:
    if args.table:
        table(read(args.out))
        return
    enable_compilation_cache()
    groups = [(f"{n} x {n}", n, count, crumples) for n, count in SHEETS.items()]
    groups += [(f"{d[0]:g} to {d[1]:g}", d, count, knots) for d, count in KNOTS.items()]
    for name, size, count, draw in groups:
        if not args.groups or name in args.groups:
            names = [f"{name} {args.seed} {k}" for k in range(count)]
            cases = Cases(draw(size, count, args.seed), names, args.out)
            while cases.run():
                pass


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
