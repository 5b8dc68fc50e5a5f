"""The command line: exit codes, one-sentence errors, defaults of environment and scale, leaving by Ctrl-C."""

import dataclasses
import json
import platform
import signal
import subprocess
import sys
import textwrap
import time
import types

import jax
import pytest
import toys

from rewax.agents import registry as agents
from rewax.agents.registry import Algorithm
from rewax.agents.sapo import SAPOConfig
from rewax.cli import train as cli
from rewax.cli.main import main as command
from rewax.envs import registry
from rewax.training.config import TrainConfig
from rewax.training.loop.train import train
from rewax.training.storage.metrics import read_csv
from rewax.training.storage.saved import load_run


@dataclasses.dataclass(frozen=True, kw_only=True)
class ToyConfig:
    """The toy's hyper-parameters.

    Attributes:
      noise: of actions.
    """

    num_envs: int = 4
    horizon: int = 3
    num_iterations: int = 2
    noise: float = 0.1

    def __post_init__(self):
        if self.noise < 0:
            raise ValueError(f"noise is {self.noise}: use 0 or more")


def make(env, config):
    return toys.make_toy(env, num_envs=config.num_envs, horizon=config.horizon, noise=config.noise)


def preset(env_name, scale):
    return ToyConfig(num_iterations=2 if scale == "small" else 3)


def factory(scale):
    return toys.point_mass(5 if scale == "small" else 7)


@pytest.fixture
def main(tmp_path, monkeypatch, capfd):
    """``main(*argv)``: exit code and output of the command line, in an empty working directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(registry._FACTORIES, "PointMass", factory)
    monkeypatch.setitem(agents._ALGORITHMS, "toy", lambda: Algorithm(make, ToyConfig, preset))
    start = ["train", "--algo=toy"]
    quick = ["--train.no-plots", "--train.no-baselines", "--train.num-eval-episodes=2", "--train.no-tensorboard"]

    def call(*argv, quickly=True):
        env = [] if any(word.startswith("--env") for word in argv) else ["--env=PointMass"]
        try:
            code = command([*start, *env, *argv, *(quick if quickly else [])])
        except SystemExit as leaving:  # of the parser
            code = leaving.code
        out, err = capfd.readouterr()
        return code, out + err

    return call


def test_trains_with_the_defaults_of_the_scale(main, tmp_path):
    code, text = main("--env=PointMass")
    assert code == 0
    assert "scale small, because JAX found no accelerator; choose the other with --scale paper" in text
    run_dir = tmp_path / "runs" / "PointMass-small-toy-0"
    assert len(read_csv(run_dir / "metrics.csv")["iteration"]) == 2
    code, text = main("--env", "PointMass", "--scale", "paper", "--seed", "3", "--toy.noise", "0.2")
    assert code == 0
    config = json.loads((tmp_path / "runs" / "PointMass-paper-toy-3" / "config.json").read_text())
    assert [part["after"] for part in config["provenance"]] == [0]
    assert (config["env"], config["scale"], config["seed"], config["agent"]) == ("PointMass", "paper", 3, "toy")
    assert config["toy"] == {"num_envs": 4, "horizon": 3, "num_iterations": 3, "noise": 0.2}


def test_steps_are_rounded_up_to_iterations_and_resume_continues(main, tmp_path):
    assert main("--steps", "25", "--run-dir", "a")[0] == 0
    assert read_csv(tmp_path / "a" / "metrics.csv")["env_steps"][-1] == 36
    code, text = main("--steps", "50", "--run-dir", "a")
    assert code == 2 and "holds a run already" in text and "Traceback" not in text
    code, text = main("--steps", "50", "--toy.num-iterations", "9", "--run-dir", "b")
    assert code == 2 and "--steps and --toy.num-iterations both say how long to train: give one of them" in text
    assert main("--steps", "50", "--run-dir", "a", "--resume")[0] == 0
    assert read_csv(tmp_path / "a" / "metrics.csv")["env_steps"][-1] == 60


@pytest.mark.parametrize(
    ("argv", "sentence"),
    [
        (["--env", "PointMas"], "there is no environment named 'PointMas': did you mean 'PointMass'?"),
        (["--scale=medium"], "scale is 'medium': use one of 'paper', 'small'"),
        (["--num-seeds=100000"], "num_seeds is 100000: give an integer from 1 to 1024, and start several commands"),
        (["--toy.noise=-1"], "noise is -1.0: use 0 or more"),
        (["--train.log-every=0"], "log_every is 0: give an integer of at least 1"),
        (["--steps=0"], "steps is 0: give an integer of at least 1"),
        (["--seed=-1"], "seed is -1: give an integer from 0 to 4294967295"),
        (["--toy.noise=loud"], "--toy.noise is 'loud': give a number"),
        (["--steps", "abc"], "--steps is 'abc': give an integer, or None"),
        (["PointMass"], "rewax train takes no argument 'PointMass': did you mean --env PointMass?"),
        (["--quux=3"], "there is no option --quux: rewax train --help lists them"),
        (
            ["--toy.nois=0.1"],
            "there is no option --toy.nois: did you mean '--toy.noise'? rewax train --help lists them",
        ),
        (["--scale"], "argument --scale: expected one argument; rewax train --help lists the options"),
        (["--algo=toi"], "there is no algorithm named 'toi': did you mean 'toy'? known are ahac, apg, "),
        (["--import=nowhere.py"], "there is no file 'nowhere.py' to import: check the path"),
        (["--resume", "--run-dir=nowhere"], "there is no run directory"),
    ],
)
def test_impossible_input_is_one_sentence_and_exit_code_2(main, tmp_path, argv, sentence):
    code, text = main(*argv)
    assert code == 2
    *_, last = text.splitlines()
    assert last.startswith("error: ") and sentence in last and "Traceback" not in text
    assert not list(tmp_path.iterdir())


def test_an_unreadable_checkpoint_is_exit_code_2(main, tmp_path):
    assert main("--run-dir=a", "--train.eval-every=0", "--train.checkpoint-every=1")[0] == 0
    folder = tmp_path / "a" / "checkpoints"
    (folder / "2" / "leaves.json").write_text("{")
    code, text = main("--run-dir=a", "--resume")
    assert code == 0 and "using the one of iteration 1 before it; it is kept as 2.damaged" in text
    for step in ("1", "2"):
        (folder / step / "leaves.json").write_text("{")
    code, text = main("--run-dir=a", "--resume")
    assert code == 2 and "is damaged and cannot be read" in text and "Traceback" not in text


def test_an_imported_module_registers_a_randomised_environment(main, tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "_FACTORIES", dict(registry._FACTORIES))
    (tmp_path / "varied.py").write_text(
        "import rewax\nfrom rewax.envs import Randomized\nfrom rewax.envs.randomize import Uniform, hook\n"
        "def make(scale):\n    env = rewax.make('PointMass', scale=scale)\n"
        "    return Randomized(env=env, randomize=hook({'gain': Uniform(0.2, 0.4)}))\n"
        "rewax.register('Varied', make)\n"
    )
    code, text = main("--env=Varied", "--import=varied.py", "--run-dir=a")
    assert code == 0 and "toy on Varied" in text
    gains = load_run(tmp_path / "a").train_state.envs.drawn[".gain"]
    assert len(set(gains.tolist())) == 4 and gains.min() >= 0.2 and gains.max() < 0.4


def test_a_run_remembers_what_was_imported(main, tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "_FACTORIES", dict(registry._FACTORIES))
    (tmp_path / "remembered.py").write_text(
        "import rewax, toys\nrewax.register('Own', lambda scale: toys.point_mass())\n"
    )
    assert main("--env=Own", "--import=remembered.py", "--run-dir=a")[0] == 0

    def forget():
        registry._FACTORIES.pop("Own")
        sys.modules.pop("remembered", None)

    forget()
    monkeypatch.chdir("/")
    assert int(load_run(tmp_path / "a").train_state.iteration) == 2
    forget()
    code, text = main("--env=Own", f"--run-dir={tmp_path / 'a'}", "--resume", "--steps=36")
    assert code == 0 and "resuming" in text
    assert json.loads((tmp_path / "a" / "config.json").read_text())["imports"] == [
        {"name": "remembered", "folder": str(tmp_path)}
    ]
    saved = load_run(tmp_path / "a")
    options = {"num_iterations": 4, "run_dir": str(tmp_path / "a"), "plots": False, "tensorboard": False}
    train(saved.agent, saved.env, TrainConfig(**options, eval_every=0, num_eval_episodes=1, resume=True))
    assert {"imports", "seed"} <= set(json.loads((tmp_path / "a" / "config.json").read_text()))
    forget()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "remembered.py").write_text("import rewax\n")
    with monkeypatch.context() as patch:  # another project's module of the same name comes first
        patch.syspath_prepend(tmp_path / "other")
        with pytest.raises(ValueError, match=r"in .*, but that in .*/other would be imported: rename one of them"):
            load_run(tmp_path / "a")
    (tmp_path / "remembered.py").unlink()
    with pytest.raises(ValueError, match=r"with --import of the module 'remembered' in .*, which is gone: put it back"):
        load_run(tmp_path / "a")


def test_what_a_factory_returns_is_checked(main, tmp_path, monkeypatch):
    monkeypatch.setitem(registry._FACTORIES, "Number", lambda scale: 5)
    code, text = main("--env=Number")
    assert code == 2 and "the factory of 'Number' returned '5', which has no method reset: return an env" in text
    monkeypatch.setitem(registry._FACTORIES, "Breaks", lambda scale: [][0])
    code, text = main("--env=Breaks")
    assert code == 2 and "building Breaks at scale small failed at " in text and "IndexError" in text
    for change, sentence in (
        ({"make": lambda env, config: 5}, "make of the algorithm 'toy' returned 5: return a rewax.agents.base.Agent"),
        ({"preset": lambda env, scale: 5}, "the preset of toy returned 5: return a ToyConfig"),
    ):
        changed = Algorithm(make, ToyConfig, preset)._replace(**change)
        monkeypatch.setitem(agents._ALGORITHMS, "toy", lambda changed=changed: changed)
        code, text = main()
        assert code == 2 and sentence in text and "Traceback" not in text
    assert not list(tmp_path.iterdir())


def test_a_run_that_fails_is_exit_code_1(main, monkeypatch):
    usual = make

    def fragile(env, config):
        agent = usual(env, config)
        counts = {"failed_episodes": 3, "episodes": 4, "failed_env": -1, "failed_leaf": -1}

        @jax.jit
        def train_step(state):
            state, metrics = agent.train_step(state)
            return state, {**metrics, **counts}

        return agent._replace(train_step=train_step)

    monkeypatch.setattr(sys.modules[__name__], "make", fragile)
    code, text = main("--steps=60", "--train.failure-window=2")
    assert code == 1 and "failed after iteration 2 of 5: 6 of 8 episodes failed numerically" in text
    assert main("--steps=12", "--run-dir=b", "--train.max-failed-share=1")[0] == 0


def test_a_place_that_cannot_be_is_exit_code_2(main, tmp_path):
    (tmp_path / "file").write_text("x")
    code, text = main("--run-dir=file")
    assert code == 2 and "file, which is not a directory: choose another directory" in text
    assert "Traceback" not in text and "compiling" not in text


def test_help_lists_every_hyperparameter(main):
    code, text = main("--help", quickly=False)
    assert code == 0
    for option in (
        "--env",
        "--scale",
        "--algo",
        "--import MODULE",
        "--resume",
        "--toy.noise",
        "--train.eval-every",
        "of actions.",
    ):
        assert option in text


SLOW = textwrap.dedent("""
    import sys, time
    import jax, jax.numpy as jnp, toys
    from rewax.agents.registry import Algorithm, register_algorithm
    from rewax.cli.main import main
    from rewax.envs import registry
    sys.path.insert(0, sys.argv.pop(1))
    import test_train
    registry.register("PointMass", test_train.factory)
    def make(env, config):
        agent = test_train.make(env, config)
        def slow(state):
            wait = lambda iteration: (print("iterating", flush=True), time.sleep(PAUSE), iteration)[2]
            iteration = jax.pure_callback(wait, jax.ShapeDtypeStruct((), jnp.int32), state.iteration)
            return agent.train_step(state.replace(iteration=iteration))
        return agent._replace(train_step=jax.jit(slow))
    register_algorithm("toy", Algorithm(make, test_train.ToyConfig, test_train.preset))
    sys.exit(main(["train", "--algo=toy", "--env=PointMass", *sys.argv[1:]]))
""")


def start(tmp_path, pause):
    """A process that trains slowly; it is in its first iteration when this returns."""
    argv = [
        "--run-dir=a",
        "--steps=100000",
        "--train.eval-every=0",
        "--train.no-baselines",
        "--train.num-eval-episodes=2",
    ]
    process = subprocess.Popen(
        [sys.executable, "-c", SLOW.replace("PAUSE", str(pause)), str(__file__).rpartition("/")[0], *argv],
        cwd=tmp_path,
        env=toys.subprocess_environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    for line in process.stdout:
        if line.startswith("iterating"):
            return process
    raise AssertionError("the process ended before it trained")


def test_ctrl_c_saves_and_leaves_with_130(tmp_path):
    process = start(tmp_path, 0.5)
    time.sleep(1.5)
    process.send_signal(signal.SIGINT)
    text, _ = process.communicate(timeout=240)
    assert process.returncode == 130
    assert "the same command continues from" in text and "Traceback" not in text
    done = len(read_csv(tmp_path / "a" / "metrics.csv")["iteration"])
    assert (tmp_path / "a" / "checkpoints" / str(done)).is_dir()
    assert (tmp_path / "a" / "learning_curve.png").exists()


def test_a_second_ctrl_c_leaves_at_once(tmp_path):
    process = start(tmp_path, 100)
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    assert "once more to leave at once" in process.stdout.readline()
    process.send_signal(signal.SIGINT)  # the same press, passed on by a supervisor
    time.sleep(1.0)
    assert process.poll() is None
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=60) == 130
    assert time.monotonic() - began < 20
    process.stdout.close()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc's mallopt")
def test_freed_memory_is_kept():
    program = """
    import ctypes, resource
    from rewax.cli.train import keep_freed_memory
    c = ctypes.CDLL(None)
    c.malloc.restype, size = ctypes.c_void_p, 40 * 2**20
    def faults():
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(5):
            block = ctypes.c_void_p(c.malloc(ctypes.c_size_t(size)))
            c.memset(block, 1, ctypes.c_size_t(size))
            c.free(block)
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
    fresh = faults()
    keep_freed_memory()
    faults()  # the heap grows
    print(fresh, faults())
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, check=True)
    fresh, kept = map(int, done.stdout.split())
    assert kept < 0.01 * fresh


def test_no_algorithm_can_have_the_name_of_an_option():
    first = types.SimpleNamespace(env="PointMass", algo="sapo")
    options = {field.name for field in dataclasses.fields(cli._options(first, "small", SAPOConfig()))} - {"sapo"}
    assert options == set(agents._OPTIONS)
