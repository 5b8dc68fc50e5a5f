"""Bad inputs, drawn with a seed: command lines, configurations, edited config.json, scenes, MJCF. Each must cost one
clear sentence.

    python tests/input_fuzzer.py --cases 1500 --seed 1

prints every input that ends in another exception than ValueError, in a message that is not one sentence, or in
acceptance. Nothing is compiled: a command ends where its work would begin.
"""

import argparse
import contextlib
import dataclasses
import io
import json
import os
import random
import string
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import toys
from scene_fuzzer import bad_models, bad_scenes

from rewax.agents.registry import algorithm, list_algorithms
from rewax.cli import main as command_line
from rewax.cli import train as train_command
from rewax.envs import registry
from rewax.training.config import TrainConfig
from rewax.training.storage import saved
from rewax.training.storage.saved import load_run

ENV = "PointMass"
TEXTS = ("abc", "", "1.5.2", "--", "[]", "None!", "ja", "1e", "0x", "é", "a b")
COMMANDS = {
    "eval": ["nowhere"],
    "play": ["nowhere"],
    "export": ["nowhere"],
    "plot": ["nowhere"],
    "landscape": ["--run-dir=nowhere"],
    "bench": ["smoke"],
    "tune": [],
    "check": [f"--env={ENV}"],
    "envs": [],
    "completion": ["bash"],
}
"""Commands with arguments that name what is needed."""
ALGORITHMS = list_algorithms()
"""Without those that tests register later: the same seed draws the same cases."""
NAMES = ("observe", "critic_observe")
"""Options that take any names: only an environment knows which of them exist."""


class Accepted(BaseException):
    """The work would begin: the input was taken for a good one."""


class Finding(NamedTuple):
    """An input that was not refused in one sentence, and what came instead."""

    case: str
    outcome: str


def _accept(*args: Any, **kwargs: Any) -> Any:
    raise Accepted


def _bad_number(rng: random.Random, default: Any) -> str:
    """A text that no option with this default takes."""
    if isinstance(default, bool):
        return rng.choice(("3", "-3", "yes", "None", "nan"))
    if isinstance(default, int):
        return rng.choice((*TEXTS, "2.5", "nan", "inf", "-7", "1e3", "99999999999999999999999.5"))
    return rng.choice((*TEXTS, "nan", "inf", "-inf"))


def _typo(rng: random.Random, name: str) -> str:
    i = rng.randrange(len(name))
    return name[:i] + rng.choice(string.ascii_lowercase) + rng.choice(string.digits) + name[i + 1 :]


def command_lines(rng: random.Random) -> Iterator[list[str]]:
    """Command lines that cannot be."""
    while True:
        algo = rng.choice(ALGORITHMS)
        config = algorithm(algo).preset(ENV, "small")
        train = ["train", f"--algo={algo}", f"--env={ENV}", "--scale=small"]
        fields = [field.name for field in dataclasses.fields(config)]
        name = rng.choice([one for one in fields if isinstance(getattr(config, one), (int, float))])
        option = f"--{algo}.{name.replace('_', '-')}"
        counts = ("log_every", "eval_every", "num_eval_episodes", "checkpoint_every", "keep_checkpoints", "num_frames")
        counted = f"--train.{rng.choice(counts).replace('_', '-')}"
        command, needed = rng.choice(list(COMMANDS.items()))
        yield rng.choice((
            [*train, f"{option}={_bad_number(rng, getattr(config, name))}"],
            [*train, option + ("x" if isinstance(getattr(config, name), bool) else "")],
            [*train, f"{_typo(rng, option)}=3"],
            [*train, f"{counted}={_bad_number(rng, 1)}"],
            [*train, f"--train.max-failed-share={rng.choice(('-1', '2', 'nan', 'x'))}"],
            [*train, f"--{rng.choice(('seed', 'steps', 'devices', 'num-seeds'))}={rng.choice((*TEXTS, '-1', '2.5', '1e6'))}"],
            [*train, f"--seed={rng.choice((2**32, 2**63, 10**30))}"],
            [*train, rng.choice(("RollingFlat", "sapo", "x", "-", "=", "@"))],
            [*train[:2], f"--env={_typo(rng, ENV)}"],
            [*train[:3], f"--scale={_typo(rng, 'small')}"],
            [f"--algo={_typo(rng, algo)}", *train] if rng.random() < 0.1 else ["train", f"--algo={_typo(rng, algo)}"],
            [*train, f"--import={rng.choice(('nowhere', 'nowhere.py', 'a..b', '.', '', 'json.py', '/', 'a/b'))}"],
            [*train, "--resume", "--run-dir=nowhere"],
            [*train, "--devices", rng.choice(("-1", "x", "1.5"))],
            [_typo(rng, "train")],
            [command, *needed, f"--{_typo(rng, 'episodes')}=3"],
            [command, *needed, rng.choice(("--seed", "--step", "--episodes", "--frames")) + "=" + rng.choice(("x", "-1", "2.5"))],
            [command, *needed, "stray", "words"] if command in ("tune", "check") else [command, *needed, "--", "--x"],
            ["eval", *rng.choice(([], ["a", "--run-dir=b"], ["nowhere"], ["--video-size", "1", "2"], ["--json"]))],
            ["envs", _typo(rng, ENV)],
            ["completion", _typo(rng, "bash")],
            ["bench", _typo(rng, "smoke")],
            ["tune", f"--env={ENV}", f"--seeds={rng.choice(('x', '-1', '1.5'))}"],
            ["tune", f"--env={ENV}", f"--{rng.choice(('trials', 'steps', 'episodes', 'reports'))}={rng.choice(('0', '-1', 'x'))}"],
        ))  # fmt: skip


def configurations(rng: random.Random) -> Iterator[tuple[type, dict[str, Any]]]:
    """Classes of configurations, and a value that cannot be."""
    objects = (
        object(),
        {},
        {"a": 1},
        {1},
        b"x",
        1 + 2j,
        [[1]],
        ["a"],
        ("a", 1),
        float("nan"),
        float("inf"),
        -float("inf"),
    )
    kinds = [TrainConfig, *(algorithm(name).config_type for name in ALGORITHMS)]
    while True:
        kind = rng.choice(kinds)
        field = rng.choice(dataclasses.fields(kind))
        default = {"num_iterations": 1, "run_dir": "a"}.get(field.name, field.default)
        wrong: list[Any] = list(objects)
        if isinstance(default, bool):
            wrong += [-3, 0, 1, 1.0, "yes", "", None]
        elif isinstance(default, int):
            wrong += [2.5, True, False, "1", "", -7, None]
        elif isinstance(default, float):
            wrong += [True, "1", "", [0.5]]
        elif isinstance(default, str):
            wrong += [3, None, True]
        elif isinstance(default, tuple):
            wrong += [3, None, "ab", (-1.5, "x"), (True, True)]
        if default is None:
            wrong = [value for value in wrong if value is not None]
        if field.name in NAMES:
            wrong.remove(["a"])
        yield kind, {field.name: rng.choice(wrong)}


def edited_configs(rng: random.Random, good: dict[str, Any]) -> Iterator[str]:
    """Texts in place of a good ``config.json``."""
    name = good["agent"]
    while True:
        config = json.loads(json.dumps(good))
        option = rng.choice(list(config[name]))
        default = config[name][option]
        wrong = [{}, {"a": 1}, [[]], [None], float("nan")]
        wrong += ["yes", 3.5] if isinstance(default, bool) else [True] if isinstance(default, (int, float)) else []
        match rng.randrange(9):
            case 0:
                yield json.dumps(config)[: rng.randrange(1, len(json.dumps(config)) - 1)]
                continue
            case 1:
                yield rng.choice(("null", "3", "[]", '"text"', "", "\x00", "{]"))
                continue
            case 2:
                config["agent"] = rng.choice((3, None, [], {}, "nobody", "", name.upper(), True))
            case 3:
                config[name] = rng.choice((3, None, [], "text", True))
            case 4:
                config[name][_typo(rng, option)] = config[name].pop(option)
            case 5 | 6:
                config[name][option] = rng.choice(wrong)
            case 7:
                config[rng.choice(("env", "scale"))] = rng.choice((3, None, [], {}, "nothing", True, 1.5))
            case 8:
                config["env_kwargs"] = rng.choice((3, [], "text", {"nothing": 1}, {"gain": {}}, {"": 1}, [1], True))
                if config["env_kwargs"] == []:
                    config["env_kwargs"] = [0]
        yield json.dumps(config)


def outcome(call: Any) -> str:
    """What came of an input: empty if it was refused in one sentence."""
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
            warnings.simplefilter("error")
            code = call()
    except Accepted:
        return "accepted"
    except ValueError as error:
        lines = [line for line in str(error).splitlines() if line.strip()]
        return "" if len(lines) == 1 and ": " in lines[0] else f"no sentence: {str(error)[:200]!r}"
    except SystemExit as leaving:
        return f"left with {leaving.code}"
    except Exception as error:  # what is looked for
        return f"{type(error).__name__}: {str(error)[:200]}"
    lines = [line for line in err.getvalue().splitlines() if line]
    if code == 2 and len(lines) == 1 and lines[0].startswith("error: "):
        return ""
    return f"code {code}, {len(lines)} lines: {err.getvalue()[:200]!r}"


def findings(cases: int, seed: int) -> list[Finding]:
    """Try so many inputs, a fifth of each kind; those that were not refused as they should be."""
    rng, found = random.Random(seed), []
    good = {"env": ENV, "scale": "small", "agent": "sapo", "env_kwargs": {}}
    good["sapo"] = json.loads(json.dumps(dataclasses.asdict(algorithm("sapo").config_type())))
    kinds = (
        ((f"rewax {' '.join(argv)}", partial(command_line.main, argv)) for argv in command_lines(rng)),
        ((f"{kind.__name__}({given})", partial(_configure, kind, given)) for kind, given in configurations(rng)),
        ((text, partial(_load, text)) for text in edited_configs(rng, good)),
        ((case, partial(_built, build)) for case, build in bad_scenes(rng)),
        ((case, partial(_built, load)) for case, load in bad_models(rng)),
    )
    for i in range(cases):
        case, call = next(kinds[i % len(kinds)])
        if what := outcome(call):
            found.append(Finding(case, what))
    return found


def _configure(kind: type, given: dict[str, Any]) -> None:
    kind(**({"num_iterations": 1, "run_dir": "a", **given} if kind is TrainConfig else given))
    raise Accepted


def _load(text: str) -> None:
    Path("run", "config.json").write_text(text)
    load_run("run")


def _built(build: Callable[[], Any]) -> None:
    build()
    raise Accepted


@contextlib.contextmanager
def stopped_before_work() -> Iterator[Path]:
    """A working directory with the shape of a run, a small task, and no work behind any command.

    Yields:
      Path of the run's ``config.json``.
    """
    here = os.getcwd()
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        os.chdir(folder)
        stack.callback(os.chdir, here)
        Path("run", "checkpoints", "1").mkdir(parents=True)
        Path("run", "checkpoints", "1", "leaves.json").write_text("{}")
        factory = {ENV: lambda scale, **kwargs: toys.point_mass(**kwargs)}
        stack.enter_context(mock.patch.dict(registry._FACTORIES, factory))
        stack.enter_context(mock.patch.object(saved, "build_agent", _accept))
        stack.enter_context(mock.patch.object(train_command, "build_agent", _accept))
        stack.enter_context(mock.patch("rewax.fixed_sources.build_ahead", lambda **_: None))
        stack.enter_context(mock.patch("rewax.training.suites.runs.run_suite", _accept))
        stack.enter_context(mock.patch("rewax.training.tuning.study.run_study", _accept))
        stack.enter_context(mock.patch("rewax.testing.check_env", _accept))
        stack.enter_context(mock.patch.object(sys, "path", [*sys.path]))
        yield Path("run", "config.json")


def main() -> int:
    """Fuzz, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with stopped_before_work():
        found = findings(options.cases, options.seed)
    for finding in found:
        print(f"{finding.case}\n    {finding.outcome}")
    print(f"{options.cases} bad inputs, {len(found)} without one sentence")
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
