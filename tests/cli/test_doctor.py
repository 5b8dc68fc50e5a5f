"""``rewax doctor``: what it prints here, and what it says of installations that do not work."""

import pytest

from rewax.cli import doctor
from rewax.cli.main import main
from rewax.lowering import build

GOOD = {"jax": "0.10.1", "jaxlib": "0.10.1", "flax": "0.12.8", "mujoco-mjx": "3.17.0"}


def test_a_working_installation_has_no_problems(capsys, monkeypatch):
    for name in ("_device_problems", "native_problems"):
        monkeypatch.setattr(doctor, name, list)
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    assert main(["doctor"]) == 0
    said = capsys.readouterr().out
    assert "Python 3." in said and "jax 0." in said and "compiled programs: " in said
    assert said.endswith("no problems found\n")


def test_devices_are_named(capsys):
    list(doctor._device_problems())
    assert "JAX computes on " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "problem", "remedy"),
    [
        ({"jax": "0.10.2", "jaxlib": "0.10.2"}, "jax 0.10.2 miscompiles", "pip install 'jax!=0.10.2'"),
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


def test_a_harmful_flag_ends_in_exit_code_1(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "_device_problems", list)
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_deterministic_ops=true")
    assert main(["doctor"]) == 1
    assert "remove it from XLA_FLAGS" in capsys.readouterr().out


def test_a_cache_that_cannot_be_written_is_named(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setattr("rewax.training.cache.enable_compilation_cache", lambda: blocked / "cache")
    ((problem, remedy),) = doctor.cache_problems()
    assert "every start compiles anew" in problem and "JAX_COMPILATION_CACHE_DIR" in remedy


@pytest.mark.parametrize(
    ("found", "off", "said"),
    [
        (build.Loaded(object(), "/a/place.so"), False, "in C++, /a/place.so\n"),
        (build.Loaded(None, "REWAX_NATIVE=0 is set"), True, "with JAX, for REWAX_NATIVE=0 is set\n"),
    ],
)
def test_says_how_a_cpu_computes_soft_bodies(monkeypatch, capsys, found, off, said):
    monkeypatch.setattr(build, "load", lambda source: found)
    monkeypatch.setattr(build, "is_off", lambda: off)
    assert not list(doctor.native_problems())
    assert capsys.readouterr().out.endswith(said)


def test_a_missing_compiler_is_a_problem(monkeypatch):
    monkeypatch.setattr(build, "load", lambda source: build.Loaded(None, "there is no C++ compiler"))
    monkeypatch.setattr(build, "is_off", lambda: False)
    ((problem, remedy),) = doctor.native_problems()
    assert "(there is no C++ compiler)" in problem and "install a C++ compiler" in remedy
