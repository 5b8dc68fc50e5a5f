"""How far rewax's positions are from C MuJoCo's, for the models of dm_control's suite and of Gymnasium.

    pip install --no-deps dm_control gymnasium
    python benchmarks/public_models.py
    python benchmarks/public_models.py --folders my/models other/models --seconds 300

Both start in the model's first keyframe, or its reference pose, with the same random velocities, hold the same random
controls, and solve to convergence in double precision. Each model is loaded with the overrides that ``load``'s refusals
name; C MuJoCo gets the same options. Each model has a process of its own.
"""

import ast
import dataclasses
import importlib.util
import multiprocessing
import re
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
import tyro

from rewax.physics import rigid
from rewax.physics.rigid.overrides import Overrides, with_overrides

PACKAGES = {"dm_control": "suite", "gymnasium": "envs/mujoco/assets"}
"""Where packages keep their MJCF files."""
SAME = 1e-10
"""Largest difference of positions that rounding explains [m, rad, quaternions]."""


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this benchmark."""

    folders: tuple[Path, ...] = ()
    """Folders of MJCF files; none: those of the installed packages."""
    seconds: int = 150
    """Limit for each model, from the start of its process."""
    steps: int = 100
    speed: float = 0.1
    """Standard deviation of the velocities [m/s, rad/s]."""
    push: float = 0.5
    """Controls are uniform between minus this and this."""
    seed: int = 0


class Row(NamedTuple):
    """What is printed of a model; instead of a difference perhaps a sentence that says why there is none."""

    result: float | str
    overrides: str = ""
    dofs: str = ""
    touches: str = ""
    moves: str = ""


def installed() -> tuple[Path, ...]:
    """Folders of the packages' MJCF files; the packages are not imported."""
    specs = [importlib.util.find_spec(name) for name in PACKAGES]
    if None in specs:
        raise SystemExit("pip install --no-deps dm_control gymnasium, or give --folders")
    return tuple(Path(str(s.origin)).parent / folder for s, folder in zip(specs, PACKAGES.values(), strict=True) if s)


def load(path: Path) -> tuple[rigid.RigidModel, dict[str, Any]]:
    """A model, and the overrides that its refusals name, taken one after another."""
    overrides: dict[str, Any] = {}
    while True:
        try:
            return rigid.load(path, iterations=100, **overrides), overrides
        except ValueError as error:
            remedy = re.search(r"load\(\.\.\., (\w+)=(.+?)\)", str(error))
            if remedy is None or remedy[1] in overrides:
                raise
            overrides[remedy[1]] = ast.literal_eval(remedy[2])


def compare(path: Path, args: Args, answer: Connection) -> None:
    """Sends the model's row."""
    jax.config.update("jax_enable_x64", True)
    try:
        model, overrides = load(path)
    except ValueError as error:
        return answer.send(Row("refused: " + " ".join(str(error).split())))
    mj = with_overrides(mujoco.MjModel.from_xml_path(str(path)), Overrides(**overrides))
    mj.opt.solver, mj.opt.tolerance = mujoco.mjtSolver.mjSOL_NEWTON, 1e-15
    mj.opt.iterations = mj.opt.ls_iterations = 100
    rng = np.random.default_rng(args.seed)
    qvel, ctrl = args.speed * rng.standard_normal(mj.nv), rng.uniform(-args.push, args.push, mj.nu)
    data, touches = mujoco.MjData(mj), False
    if mj.nkey:
        mujoco.mj_resetDataKeyframe(mj, data, 0)
    data.qvel[:], data.ctrl[:], data.act[:] = qvel, ctrl, 0.0
    start = data.qpos.copy()
    for _ in range(args.steps):
        mujoco.mj_step(mj, data)
        touches |= data.ncon > 0
    run = jax.jit(rigid.step, static_argnames="num_substeps")
    end = run(model, rigid.initial_state(model, start, qvel), ctrl, num_substeps=args.steps).qpos
    options = ", ".join(f"{name}={value}" for name, value in overrides.items())
    difference, moves = (float(np.abs(data.qpos - other).max()) for other in (end, start))
    return answer.send(Row(difference, options, str(mj.nv), "yes" if touches else "no", f"{moves:.2g}"))


def measured(path: Path, args: Args) -> Row:
    """The row of a process that is killed when its time is over."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=compare, args=(path, args, theirs))
    process.start()
    theirs.close()
    try:
        return ours.recv() if ours.poll(args.seconds) else Row(f"no result within {args.seconds} s")
    except EOFError:
        return Row("failed: see above")
    finally:
        process.kill()
        process.join()


def main(args: Args) -> None:
    print("| model | overrides | dofs | touches | moves by | largest difference |\n|---|---|---|---|---|---|")
    rows = []
    for path in [path for folder in args.folders or installed() for path in sorted(folder.glob("*.xml"))]:
        rows.append(row := measured(path, args))
        result = row.result if isinstance(row.result, str) else f"{row.result:.1e}"
        print(f"| {path.parent.name}/{path.stem} |", " | ".join((*row[1:], result)), "|", flush=True)
    same = [(row.result, row.touches) for row in rows if not isinstance(row.result, str) and row.result < SAME]
    largest, touching = max(same, default=(0.0,))[0], sum(touches == "yes" for _, touches in same)
    print(f"\n{len(same)} of {len(rows)} models agree to {largest:.1e}, {touching} of them in contact")


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__))
