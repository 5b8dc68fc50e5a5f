"""Libraries on disk: what is damaged, or what somebody else could have written, is neither loaded nor fatal."""

import ctypes
import os
import re
import shutil
import stat
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import pytest

from benchmarks import cache_damage
from rewax.lowering import compiler, library_cache

ROOT = Path(__file__).resolve().parents[2]
pytestmark = pytest.mark.skipif(compiler.command() is None, reason="there is no C++ compiler")
needs_root = pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="root can give files away")


@pytest.fixture(scope="module")
def contents(tmp_path_factory):
    """A library's bytes."""
    folder = tmp_path_factory.mktemp("library")
    text = 'extern "C" int one() { return 1; }\n'
    return compiler.build(compiler.command(), text, compiler.FLAGS, folder)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache and an empty temporary directory."""
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    monkeypatch.setattr(library_cache, "_temporary", [])
    return tmp_path / "cache" / "rewax" / "native"


KINDS = [case.kind for case in cache_damage.cases()]
SOME = [list(cache_damage.cases())[KINDS.index(kind)] for kind in dict.fromkeys(KINDS)]


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """One damage of each kind. All: python benchmarks/cache_damage.py."""
    return {outcome.kind: outcome for outcome in cache_damage.run(SOME, tmp_path_factory.mktemp("damages"))}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are forked")
@pytest.mark.parametrize("kind", [case.kind for case in SOME])
def test_a_damage_is_survived_and_said_once(outcomes, kind):
    assert outcomes[kind].good, outcomes[kind].what


def test_a_library_is_built_once(cache, contents):
    library, path = library_cache.load("one-1", lambda folder: contents)
    assert library.one() == 1 and [*cache.iterdir()] == [path]
    assert re.fullmatch(r"one-1-[0-9a-f]{32}\.so", path.name)
    again, same = library_cache.load("one-1", lambda folder: pytest.fail("it was built again"))
    assert again.one() == 1 and same == path


@pytest.mark.parametrize("mask", [0o000, 0o022, 0o077])
def test_nobody_else_can_write_to_what_is_made(cache, contents, mask):
    before = os.umask(mask)
    try:
        _, path = library_cache.load("one-2", lambda folder: contents)
    finally:
        os.umask(before)
    modes = [stat.S_IMODE(p.stat().st_mode) for p in (path, cache, cache.parent, cache.parent.parent)]
    assert modes == [0o600, 0o700, 0o700, 0o700]


def test_the_checksum_knows_the_name(cache, contents):
    """Another library of ours in the place of one is damage, too."""
    _, path = library_cache.load("one-3", lambda folder: contents)
    other = path.rename(path.with_name(path.name.replace("one-3", "one-4")))
    assert library_cache.fault(other, "one-4", private=True) == "it is damaged"


def test_a_file_that_is_mapped_is_never_written_to(cache, contents):
    """Who has loaded it keeps its own."""
    _, path = library_cache.load("one-5", lambda folder: contents)
    with path.open("rb") as file:
        path.chmod(0o666)
        with pytest.warns(UserWarning, match="others can write to it"):
            _, new = library_cache.load("one-5", lambda folder: contents)
        assert new == path and new.stat().st_ino != os.fstat(file.fileno()).st_ino
        assert file.read() == contents


def test_file_and_folder_are_synchronized(cache, contents, monkeypatch):
    kinds, real = [], os.fsync
    monkeypatch.setattr(os, "fsync", lambda d: kinds.append(stat.S_IFMT(os.fstat(d).st_mode)) or real(d))
    library_cache.load("one-6", lambda folder: contents)
    assert kinds == [stat.S_IFREG, stat.S_IFDIR]


@needs_root
def test_another_users_folder_is_not_used(cache, contents):
    cache.mkdir(parents=True)
    os.chown(cache, 54321, 54321)
    with pytest.warns(UserWarning, match="in a temporary folder: .*/native is not used: it belongs to another user"):
        library, path = library_cache.load("one-7", lambda folder: contents)
    assert library.one() == 1 and path.parent == library_cache.temporary_folder() and not [*cache.iterdir()]


def test_without_a_home(cache, contents, monkeypatch):
    def home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", home)
    with pytest.warns(UserWarning, match="Could not determine home directory"):
        assert library_cache.load("one-8", lambda folder: contents)[0].one() == 1


def test_a_full_disk(cache, contents, monkeypatch):
    real = library_cache.keep

    def keep(home, *args):
        if home == cache:
            raise OSError(28, "No space left on device")
        return real(home, *args)

    monkeypatch.setattr(library_cache, "keep", keep)
    built = []
    with pytest.warns(UserWarning, match="one-9 cannot be kept .*No space left"):
        library, path = library_cache.load("one-9", lambda folder: built.append(1) or contents)
    assert library.one() == 1 and len(built) == 1 and path.parent == library_cache.temporary_folder()
    assert not [*cache.iterdir()]


def test_what_is_kept_but_does_not_load_is_built_again(cache, contents):
    library_cache.keep(library_cache.folder(), "one-10", b"\x7fELF of another machine")
    library, _ = library_cache.load("one-10", lambda folder: contents)
    assert library.one() == 1
    assert library_cache.load("one-10", lambda folder: pytest.fail("it was built again"))[0].one() == 1


def test_what_never_loads_is_an_error_and_is_not_kept(cache):
    with pytest.raises(OSError, match=r"invalid|short|mach-o"):
        library_cache.load("one-11", lambda folder: b"no library")
    assert not [*cache.iterdir()]


def test_build_folders_of_killed_processes_go_after_an_hour(cache, contents):
    library_cache.folder()
    for name, age in (("building-old", 7200), ("building-new", 60), ("mine", 7200)):
        (cache / name).mkdir()
        os.utime(cache / name, (time.time() - age,) * 2)
    library_cache.load("one-12", lambda folder: contents)
    assert {p.name for p in cache.iterdir() if p.is_dir()} == {"building-new", "mine"}


def test_temporary_folders_of_killed_processes_go_too(cache):
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    home = Path(tempfile.gettempdir())
    for name in (f"rewax-native-{ended.pid}-a", f"rewax-native-{os.getpid()}-b"):
        (home / name).mkdir()
        os.utime(home / name, (time.time() - 7200,) * 2)
    mine = library_cache.temporary_folder()
    assert {p.name for p in home.iterdir()} == {f"rewax-native-{os.getpid()}-b", mine.name}
    shutil.rmtree(mine)  # as programs do that clean up /tmp
    assert library_cache.temporary_folder().is_dir()


def test_a_process_leaves_no_temporary_folder(tmp_path):
    (tmp_path / "file").write_text("")
    program = (
        "import os\nfrom rewax.lowering import build\n"
        "print(build.load(build.Source('one', 'extern \"C\" int one() { return 1; }')).reason)\n"
        "if os.fork() == 0: raise SystemExit\n"
        "os.wait(); assert os.path.exists(build.load(build.Source('one', 'extern \"C\" int one() { return 1; }')).reason)"
    )
    environment = {
        **os.environ, "XDG_CACHE_HOME": str(tmp_path / "file"), "TMPDIR": str(tmp_path), "PYTHONPATH": str(ROOT),
    }  # fmt: skip
    environment.pop("REWAX_NATIVE", None)
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(tmp_path)) and done.stderr.count("UserWarning") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_many_processes_at_once(cache, contents, tmp_path):
    """All repair the same damaged files, and each removes some that others have just built or are about to load."""
    home = library_cache.folder()
    for k in range(40):
        os.truncate(library_cache.keep(home, f"one-{k}", contents), 1000)
    (tmp_path / "library").write_bytes(contents)
    program = (
        "import random, sys, warnings\nfrom pathlib import Path\nfrom rewax.lowering import library_cache\n"
        "warnings.simplefilter('ignore')\nrandom.seed(int(sys.argv[1]))\n"
        "print(flush=True); sys.stdin.readline()\n"
        "for k in range(40):\n"
        "    library, path = library_cache.load(f'one-{k}', lambda folder: Path(sys.argv[2]).read_bytes())\n"
        "    assert library.one() == 1\n"
        "    if random.random() < 0.3: path.unlink(missing_ok=True)\n"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    commands = [[sys.executable, "-c", program, str(k), str(tmp_path / "library")] for k in range(4)]
    running = [subprocess.Popen(c, env=environment, text=True, **pipes) for c in commands]
    for process in running:
        process.stdout.readline()
    for process in running:
        process.stdin.write("\n")
        process.stdin.flush()
    for process in running:
        _, errors = process.communicate()
        assert process.returncode == 0, errors
    assert all(library_cache.fault(path, path.name[:-36], private=True) is None for path in home.glob("*.so"))


def test_a_whole_library_is_used_without_a_word(cache, contents):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path = library_cache.keep(library_cache.folder(), "one-13", contents)
        assert library_cache.find(cache, "one-13", private=True) == (path, [])
        assert library_cache.find(cache, "one-14", private=True) == (None, [])
    assert ctypes.CDLL(str(path)).one() == 1
