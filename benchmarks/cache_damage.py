"""Damages the cache of C++ libraries in some 200 ways and loads a library from it, each time in a process of its own.

A process must not crash, the library must give the right number, and the user must read one sentence where something
was wrong, none where nothing was. Files and folders of other users need root, and are left out without it.

    python benchmarks/cache_damage.py               # a table of kinds and outcomes; exit code 1 if one is bad
"""

import argparse
import collections
import dataclasses
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

NUMBERS = 20_000
TEXT = (
    f"extern const int kNumbers[{NUMBERS}] = {{{','.join(map(str, range(NUMBERS)))}}};\n"
    'extern "C" long rewax_total() { long s = 0; for (volatile const int& n : kNumbers) s += n; return s; }\n'
)
"""A library of many pages, all of which it reads."""
WRONG_TEXT = 'extern "C" long rewax_total() { return 666; }\n'
TOTAL = sum(range(NUMBERS))
OTHER_USER = 54321
_HANGS_S = 300


@dataclasses.dataclass(frozen=True)
class Case:
    """One damage."""

    kind: str
    damage: Callable[[Path], None]
    """What it does, given the library that was kept."""
    sentences: int = 1
    """How many the user should read."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of it."""

    kind: str
    good: bool
    what: str


def cases() -> Iterator[Case]:
    """All damages."""
    draw = random.Random(0)
    for k in range(64):
        yield Case("truncated", lambda path, k=k: os.truncate(path, path.stat().st_size * k // 64))
    for pages in range(1, 9):
        for offset in (-1, 0):
            yield Case("truncated near a page", lambda path, n=4096 * pages + offset: os.truncate(path, n))
    for where, bit in [(draw.random(), draw.randrange(8)) for _ in range(48)]:
        yield Case("one bit flipped", lambda path, where=where, bit=bit: flip(path, where, 1 << bit))
    for k in range(16):
        yield Case("4 kB of zeros", lambda path, k=k: zeros(path, path.stat().st_size * k // 16, 4096))
    yield Case("zeros only", lambda path: zeros(path, 0, path.stat().st_size))
    yield Case("empty", lambda path: os.truncate(path, 0))
    for count in (1, 100, 4096):
        yield Case("longer", lambda path, n=count: path.write_bytes(path.read_bytes() + bytes(n)))
    yield Case("a sparse file of 1 TB", lambda path: os.truncate(path, 2**40))
    yield Case("text", lambda path: path.write_text("no library"))
    yield from _names()
    yield from _things()
    yield from _modes()
    if os.geteuid() == 0:
        yield from _owners()


def _names() -> Iterator[Case]:
    def renamed(path: Path, change: Callable[[str], str]) -> None:
        path.rename(path.with_name(change(path.name)))

    yield Case("no checksum", lambda path: renamed(path, lambda name: name.rpartition("-")[0] + ".so"))
    yield Case("checksum cut", lambda path: renamed(path, lambda name: name[:-8] + ".so"))
    yield Case("checksum changed", lambda path: renamed(path, lambda name: name[:-35] + "0" * 32 + ".so"))
    yield Case("checksum changed", lambda path: renamed(path, str.upper), sentences=0)
    yield Case("another library under its name", lambda path: shutil.copy(_library(WRONG_TEXT), path))
    yield Case("a second one, damaged", lambda path: path.with_name(path.name[:-35] + "g" * 32 + ".so").touch(), 0)
    yield Case("a second one, damaged", lambda path: path.with_name(path.name[:-35] + "-.so").touch())


def _things() -> Iterator[Case]:
    def put(make: Callable[[Path], object]) -> Callable[[Path], None]:
        def damage(path: Path) -> None:
            moved = path.rename(path.with_name("moved"))
            make(path)
            if not path.is_symlink() or os.readlink(path) != moved.name:
                moved.unlink()

        return damage

    yield Case("a folder in its place", put(Path.mkdir))
    yield Case("a folder in its place", put(lambda path: (path / "a" / "b").mkdir(parents=True)))
    yield Case("a pipe in its place", put(os.mkfifo))
    for target in ("moved", "/dev/zero", "/etc/passwd", "/nonexistent", "/proc/self/mem"):
        yield Case("a link in its place", put(lambda path, target=target: path.symlink_to(target)))
    yield Case("a link in its place", put(lambda path: path.symlink_to(path)))
    yield Case("gone", Path.unlink, sentences=0)
    yield Case("the folder is gone", lambda path: shutil.rmtree(path.parent), sentences=0)
    for up in (0, 1, 2):

        def file(path: Path, up: int = up) -> None:
            shutil.rmtree(path.parents[up])
            path.parents[up].write_text("a file")

        yield Case("a file instead of the folder", file)
    yield Case("the folder is a link", lambda path: _linked(path.parent), sentences=0)
    yield Case("the folder is a dangling link", lambda path: _linked(path.parent, gone=True))


def _linked(folder: Path, gone: bool = False) -> None:
    moved = folder.rename(folder.with_name("elsewhere"))
    folder.symlink_to(moved)
    if gone:
        shutil.rmtree(moved)


def _modes() -> Iterator[Case]:
    for mode in (0o666, 0o777, 0o602, 0o660, 0o722):
        yield Case("others can write the file", lambda path, mode=mode: path.chmod(mode))
    for mode in (0o600, 0o400, 0o755, 0o644):
        yield Case("others cannot write the file", lambda path, mode=mode: path.chmod(mode), sentences=0)
    for mode in (0o777, 0o1777, 0o770, 0o755, 0o2777):
        yield Case("others can enter the folder", lambda path, mode=mode: path.parent.chmod(mode), sentences=0)
        yield Case("others can write above it", lambda path, m=mode: path.parent.parent.chmod(m), sentences=0)


def _owners() -> Iterator[Case]:
    def owned(path: Path, mode: int) -> None:
        os.chown(path, OTHER_USER, OTHER_USER)
        path.chmod(mode)

    for mode in (0o600, 0o644, 0o755, 0o777):
        yield Case("the file of another user", lambda path, mode=mode: owned(path, mode))
    for up in (0, 1):
        for mode in (0o700, 0o755, 0o777, 0o1777):
            yield Case("the folder of another user", lambda path, u=up, m=mode: owned(path.parents[u], m))

    def planted(path: Path) -> None:
        from rewax.lowering import library_cache

        name = path.name.rpartition("-")[0]
        path.unlink()
        owned(library_cache.keep(path.parent, name, _library(WRONG_TEXT).read_bytes()), 0o755)
        path.parent.chmod(0o777)

    yield Case("another user's own library, whole", planted)


def flip(path: Path, where: float, bit: int) -> None:
    contents = bytearray(path.read_bytes())
    contents[int(where * len(contents))] ^= bit
    path.write_bytes(contents)


def zeros(path: Path, begin: int, count: int) -> None:
    contents = path.read_bytes()
    path.write_bytes(contents[:begin] + bytes(min(count, len(contents) - begin)) + contents[begin + count :])


def _library(text: str) -> Path:
    from rewax.lowering import build

    return Path(build.load(build.Source("wrong", text)).reason)


# --- Processes --------------------------------------------------------------------------------------------------------


def run(chosen: list[Case], folder: Path, what: str = "total") -> list[Outcome]:
    """Each case in a process of its own, forked from one that has imported JAX.

    Args:
      folder: an empty folder.
      what: ``"total"``, a small library, or ``"transfer"``, the particles' transfers.
    """
    command = [sys.executable, __file__, "--worker", what]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as worker:
        assert worker.stdin and worker.stdout

        def ask(cache: Path) -> dict:
            worker.stdin.write(f"{cache}\n")
            worker.stdin.flush()
            return json.loads(worker.stdout.readline())

        first = ask(folder / "good")
        assert first["right"] and not first["sentences"], first
        outcomes = []
        for k, case in enumerate(chosen):
            cache = folder / f"case_{k}"
            shutil.copytree(folder / "good", cache)
            case.damage(cache / Path(first["path"]).relative_to(folder / "good"))
            outcomes.append(_judged(case, ask(cache)))
            again = ask(cache)
            if not again["right"]:
                outcomes[-1] = Outcome(case.kind, False, f"the second time {again}")
        worker.stdin.close()
    return outcomes


def _judged(case: Case, found: dict) -> Outcome:
    if "status" in found:
        return Outcome(case.kind, False, f"process ended with status {found['status']}")
    said = found["sentences"]
    kept = "built, kept" if found["built"] and found["kept"] else "built, not kept" if found["built"] else "used"
    what = f"{kept}, {len(said)} sentence{'s' * (len(said) != 1)}"
    if not found["right"]:
        return Outcome(case.kind, False, f"wrong number ({found})")
    return Outcome(case.kind, len(said) == case.sentences, what if len(said) == case.sentences else f"{what}: {said}")


def worker(what: str) -> None:
    """Load the library from each cache that standard input names, and say on standard output what happened."""
    import jax

    jax.config.update("jax_platforms", "cpu")
    from rewax.lowering import build, compiler
    from rewax.physics.mpm import transfer_cpp

    os.environ.pop("REWAX_NATIVE", None)
    source = build.Source("total", TEXT) if what == "total" else transfer_cpp.SOURCE
    run_compiler = compiler.build
    built = []
    compiler.build = lambda *args: built.append(1) or run_compiler(*args)
    compiler.version(compiler.command() or ())
    for line in sys.stdin:
        cache = Path(line.rstrip("\n"))
        receive, send = os.pipe()
        child = os.fork()
        if child == 0:
            signal.alarm(_HANGS_S)
            os.environ["XDG_CACHE_HOME"] = str(cache)
            os.environ["REWAX_NATIVE"] = "build"
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("default")
                library, reason = build.load(source)
                right = library is not None
                right = right and (library.rewax_total() == TOTAL if what == "total" else transfers_agree())
            found = {
                "right": bool(right), "path": reason, "built": bool(built), "kept": Path(reason).is_relative_to(cache),
                "sentences": [str(w.message) for w in said],
            }  # fmt: skip
            os.write(send, json.dumps(found).encode())
            from rewax.lowering import library_cache

            for path in library_cache._temporary:
                shutil.rmtree(path, ignore_errors=True)
            os._exit(0)
        os.close(send)
        with os.fdopen(receive) as pipe:
            answer = pipe.read()
        _, status = os.waitpid(child, 0)
        print(
            answer if status == 0 else json.dumps({"status": os.waitstatus_to_exitcode(status), "right": False}),
            flush=True,
        )


def transfers_agree() -> bool:
    """Whether the library's sums of particles on nodes are those of JAX."""
    import jax
    import numpy as np

    from rewax.physics.mpm import transfer_cpp, transfer_xla_cpu
    from rewax.physics.mpm.grid import Grid

    draw, grid = np.random.default_rng(0), Grid(shape=(9, 8, 7), spacing=0.1)
    where = tuple(np.float32(draw.uniform(0.06, 0.1 * (n - 1.6), 50)) for n in grid.shape)
    given = tuple(np.float32(draw.standard_normal((13, 50))))
    layout = transfer_xla_cpu.Layout(grid, None)
    scatter = [jax.jit(lambda m=m: m.scatter(layout, where, given))() for m in (transfer_cpp, transfer_xla_cpu)]
    used = transfer_cpp.is_used()
    return used and all(np.allclose(a, b, rtol=1e-4, atol=1e-4) for a, b in zip(*scatter, strict=True))


def main() -> int:
    """Run all cases and print what became of them."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--worker", default="")
    if what := parser.parse_args().worker:
        worker(what)
        return 0
    every = list(cases())
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "total").mkdir()
        (Path(folder) / "transfer").mkdir()
        outcomes = run(every, Path(folder) / "total")
        outcomes += run(every[1::23], Path(folder) / "transfer", "transfer")
    table = collections.Counter((o.kind, "" if o.good else "BAD: ", o.what) for o in outcomes)
    for (kind, bad, what), count in table.items():
        print(f"{count:4}  {kind:36} {bad}{what}")
    bad = sum(not o.good for o in outcomes)
    print(f"{len(outcomes)} damages, {bad} bad outcomes")
    return bool(bad)


if __name__ == "__main__":
    sys.exit(main())
