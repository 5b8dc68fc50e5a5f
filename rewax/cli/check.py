"""``rewax check``: checks an environment, or an algorithm on it, against the protocol."""

import dataclasses
import sys
from collections.abc import Sequence

from rewax.agents.legal import Seed
from rewax.cli.options import Imports, build_env, import_modules, parse
from rewax.cli.train import quiet

_PROBLEM_FOUND = 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options.

    Attributes:
      env: name of the environment, see ``rewax envs``.
      scale: ``small`` or ``paper``.
      algo: name of an algorithm: check its agent, with its preset, instead of the environment.
      imports: module or .py file that registers environments or algorithms.
      seed: draws initial states and actions.
      may_be_nan: with ``algo``: metrics that may be NaN.
      whole_episode: also run one episode to its end, which may take long.
      compare_gradient: compare the gradient of the reward with central differences. Leave it out where a stop_gradient
        changes the gradient on purpose.
      in_cpp: also require that all laws, contacts and bodies run in C++ on a CPU, with both derivatives.
    """

    env: str
    scale: str = "small"
    algo: str = ""
    imports: Imports = ()
    seed: Seed = 0
    may_be_nan: tuple[str, ...] = ("return",)
    whole_episode: bool = True
    compare_gradient: bool = True
    in_cpp: bool = False


def run(argv: Sequence[str]) -> int:
    """Check an environment, or an algorithm on it, part by part.

    Returns:
      Exit code: 0 if it conforms to the protocol; 1 after a sentence about a problem.

    Raises:
      ValueError: there is no such environment, scale or algorithm.
    """
    from rewax.agents.registry import algorithm
    from rewax.testing import check_agent, check_env, where_it_runs
    from rewax.testing.env import GRADIENT_TOLERANCE
    from rewax.training.storage.cache import enable_compilation_cache
    from rewax.training.storage.modules import user_error

    quiet()
    options = parse(Options, argv, prog="rewax check", description="Check an environment or an algorithm.")
    if options.algo and (options.in_cpp or not (options.whole_episode and options.compare_gradient)):
        raise ValueError(
            "--in-cpp, --no-whole-episode and --no-compare-gradient belong to the check of an environment: leave out "
            "--algo"
        )
    if not options.algo and options.may_be_nan != Options.may_be_nan:
        raise ValueError("--may-be-nan names metrics of an algorithm: also give --algo, or leave it out")
    enable_compilation_cache()
    import_modules(options.imports)
    env = build_env(options.env, options.scale)
    known = algorithm(options.algo) if options.algo else None
    try:
        if known is not None:
            agent = known.make(env, known.preset(options.env, options.scale))
            check_agent(agent, env, seed=options.seed, may_be_nan=options.may_be_nan)
            print(f"{options.algo} on {options.env} at scale {options.scale} keeps the protocol")
            return 0
        tolerance = GRADIENT_TOLERANCE if options.compare_gradient else None
        check_env(env, seed=options.seed, check_full_episode=options.whole_episode, gradient_tolerance=tolerance)
    except AssertionError as problem:
        print(f"problem: {problem}", file=sys.stderr)
        return _PROBLEM_FOUND
    except Exception as error:
        known_error = user_error(error, f"the check of {options.algo or options.env}")
        in_users_code = " failed at " in str(known_error)
        if not in_users_code and not isinstance(error, (TypeError, AttributeError)):
            raise
        where = "" if in_users_code else ": look at what its methods return"
        print(f"problem: {known_error}{where}", file=sys.stderr)
        return _PROBLEM_FOUND
    left = [decision for decision in where_it_runs(env) if decision.reason] if options.in_cpp else []
    for decision in left:
        print(f"problem: {decision}", file=sys.stderr)
    if left:
        return _PROBLEM_FOUND
    print(f"{options.env} at scale {options.scale} keeps the protocol")
    return 0


__all__ = ["Options", "run"]
