"""``rewax doctor``: what it prints here, and what it says of installations that do not work."""

import itertools

import pytest
from native_cases import NEEDS_COMPILER

from rewax.cli import doctor
from rewax.cli.main import main
from rewax.envs import registry
from rewax.lowering import build, shipped

GOOD = {"jax": "0.10.1", "jaxlib": "0.10.1", "flax": "0.12.8", "mujoco-mjx": "3.17.0"}


def test_a_working_installation_has_no_problems(capsys, monkeypatch):
    for name in ("_device_problems", "native_problems"):
        monkeypatch.setattr(doctor, name, list)
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    assert main(["doctor"]) == 0
    said = capsys.readouterr().out
    assert "Python 3." in said and "jax 0." in said and "compiled programs: " in said
    assert said.endswith("no problems found\n")


def test_modules_are_imported_and_errors_of_an_environment_are_one_sentence(capsys, monkeypatch, tmp_path):
    for name in ("_device_problems", "native_problems"):
        monkeypatch.setattr(doctor, name, list)
    assert main(["doctor", "--import", "no.such.module"]) == 2
    assert "there is no module 'no.such.module' to import" in capsys.readouterr().err
    monkeypatch.setitem(registry._FACTORIES, "Bad", lambda scale: {}["missing"])
    assert main(["doctor", "--env", "Bad"]) == 2
    assert "building Bad at scale small failed" in capsys.readouterr().err


def test_devices_are_named(capsys):
    list(doctor._device_problems())
    assert "JAX computes on " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "problem", "remedy"),
    [
        ({"jax": "0.10.2", "jaxlib": "0.10.2"}, "jax 0.10.2 miscompiles", "pip install 'jax>=0.10.1,!=0.10.2"),
        (
            {"jax": "0.11.0", "jaxlib": "0.11.0"},
            "jax 0.11.0 compiles sums",
            "pip install 'jax>=0.10.1,!=0.10.2,!=0.11.0'",
        ),
        ({"jax": "0.9.3", "jaxlib": "0.9.3"}, "jax 0.9.3 is older", "pip install -U 'jax>=0.10.1"),
        ({"jaxlib": "0.11.0"}, "jax 0.10.1 and jaxlib 0.11.0 do not belong together", "pip install 'jaxlib==0.10.1'"),
        ({"flax": "0.12.7"}, "flax 0.12.7 fails to import", "pip install -U 'flax>=0.12.8'"),
        ({"mujoco-mjx": "4.0.1"}, "mujoco-mjx 4.0.1", "pip install 'mujoco-mjx>=3.17,<4'"),
        ({"mujoco-mjx": None}, "mujoco-mjx is not installed", "pip install mujoco-mjx"),
    ],
)
def test_versions_that_do_not_work_are_named_with_the_remedy(changes, problem, remedy):
    ((found, cure),) = doctor.version_problems({**GOOD, **changes})
    assert found.startswith(problem) and cure.startswith(remedy)


def test_good_versions_are_no_problem():
    assert not list(doctor.version_problems(GOOD))
    assert not list(doctor.version_problems({**GOOD, "jax": "0.11.2", "jaxlib": "0.11.1", "flax": "0.13.0rc1"}))


def test_a_newer_jax_is_a_note_and_no_problem(monkeypatch, capsys):
    newer = {**GOOD, "jax": "0.13.1", "jaxlib": "0.13.1"}
    assert not list(doctor.version_problems(newer))
    (note,) = doctor.version_notes(newer)
    assert note.startswith("jax 0.13.1 is newer than") and "'jax<0.13'" in note
    assert not list(doctor.version_notes(GOOD)) and not list(doctor.version_notes({**GOOD, "jax": None}))
    for name in ("_device_problems", "native_problems"):
        monkeypatch.setattr(doctor, name, list)
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    monkeypatch.setattr(doctor, "_version", lambda name: newer.get(name, "1.0"))
    assert main(["doctor"]) == 0
    assert f"note: {note}\nno problems found\n" in capsys.readouterr().out


def test_a_harmful_flag_ends_in_exit_code_1(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "_device_problems", list)
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_deterministic_ops=true")
    assert main(["doctor"]) == 1
    assert "remove it from XLA_FLAGS" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("values", "on"),
    [
        (["=true"], True), ([""], True), (["=1"], True), (["=True"], True), (["=false", "=true"], True),
        ([], False), (["=false"], False), (["=0"], False), (["=true", "=false"], False), (["_extra=true"], False),
    ],
)  # fmt: skip
def test_a_flag_is_read_as_xla_reads_it(values, on):
    flags = " ".join(f"--xla_gpu_deterministic_ops{value}" for value in values)
    assert [problem for problem, _ in doctor.flag_problems(flags)] == [
        "--xla_gpu_deterministic_ops makes the particles' scatter a serial loop on a GPU"
    ] * on


def test_a_cache_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setattr("rewax.training.storage.cache.enable_compilation_cache", lambda: blocked / "cache")
    ((problem, remedy),) = doctor.cache_problems()
    assert "every start compiles anew" in problem and "JAX_COMPILATION_CACHE_DIR" in remedy


@pytest.fixture
def native(monkeypatch, tmp_path):
    """C++ that is wanted, and a cache of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("REWAX_NATIVE", raising=False)
    monkeypatch.delenv("CXX", raising=False)


def test_says_where_libraries_come_from(monkeypatch, capsys, native, tmp_path):
    places = itertools.cycle((shipped.FOLDER / "ffi-0.3" / "x86-64-v3" / "a.so", tmp_path / "b.so"))
    monkeypatch.setattr(build, "load", lambda source: build.Loaded(object(), str(next(places))))
    assert not list(doctor.native_problems())
    said = capsys.readouterr().out
    assert (
        f"in C++, 2 libraries that came with rewax ({shipped.FOLDER}/ffi-0.3/x86-64-v3), 2 libraries that were" in said
    )
    assert f"C++ libraries are kept in {tmp_path}/rewax/native: 0 files\n" in said


@NEEDS_COMPILER
def test_names_the_compiler(monkeypatch, capsys, native):
    monkeypatch.setattr(build, "load", lambda source: build.Loaded(object(), "/a/place.so"))
    assert not list(doctor.native_problems())
    assert f"C++ compiler: {build.compiler()} (" in capsys.readouterr().out


def test_libraries_that_came_along_need_no_compiler(monkeypatch, capsys, native):
    monkeypatch.setenv("CXX", "/nonexistent")
    monkeypatch.setattr(build, "load", lambda source: build.Loaded(object(), "/a/place.so"))
    assert not list(doctor.native_problems())
    said = capsys.readouterr().out
    assert said.startswith("there is no C++ compiler (CXX=/nonexistent)\n")
    assert "physics on a CPU: in C++, 4 libraries" in said


def test_a_cache_of_libraries_that_cannot_be_used_is_a_problem(monkeypatch, native, tmp_path):
    (tmp_path / "rewax").write_text("a file")
    monkeypatch.setattr(build, "load", lambda source: build.Loaded(object(), "/a/place.so"))
    ((problem, _),) = doctor.native_problems()
    assert "C++ is built at every start" in problem and "XDG_CACHE_HOME" in problem


def test_says_that_cpp_is_turned_off(monkeypatch, capsys):
    monkeypatch.setenv("REWAX_NATIVE", "0")
    assert not list(doctor.native_problems())
    assert capsys.readouterr().out == "physics on a CPU: with JAX, for REWAX_NATIVE=0 is set\n"


def test_a_missing_compiler_is_a_problem(monkeypatch, native):
    monkeypatch.setattr(build, "load", lambda source: build.Loaded(None, "there is no C++ compiler"))
    ((problem, remedy),) = doctor.native_problems()
    assert "(there is no C++ compiler)" in problem and "install a C++ compiler" in remedy


@pytest.mark.parametrize("error", [AssertionError(), RuntimeError("Unable to initialize backend 'cup'\nmore")])
def test_without_a_device_it_goes_on(error, monkeypatch, capsys, native):
    def no_device():
        raise error

    monkeypatch.setenv("JAX_PLATFORMS", "cup")
    monkeypatch.setattr("jax.devices", no_device)
    monkeypatch.setattr("jax.default_backend", no_device)
    ((problem, remedy),) = doctor._device_problems()
    assert problem.startswith("JAX finds no device (") and "cup" in problem and "more" not in problem
    assert "set it to cpu" in remedy
    monkeypatch.setattr(build, "load", lambda source: build.Loaded(None, "there is no C++ compiler"))
    assert not list(doctor.native_problems()) and doctor._backend() is None


def test_where_nothing_runs_in_cpp_no_function_is_said_to(monkeypatch, capsys):
    monkeypatch.setattr(build, "load", lambda source: build.Loaded(None, "there is no C++ compiler"))
    doctor.print_lowering("CartpoleSwingUp", "small")
    said = capsys.readouterr().out
    assert "all functions run in XLA (there is no C++ compiler)" in said and "C++, 0" not in said
