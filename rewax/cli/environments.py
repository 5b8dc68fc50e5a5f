"""``rewax envs``: the names that ``--env`` takes."""

import dataclasses
from collections.abc import Sequence

from rewax.cli.options import Imports, import_modules, parse


@dataclasses.dataclass(frozen=True, kw_only=True)
class Options:
    """Options.

    Attributes:
      imports: module or .py file that registers environments.
    """

    imports: Imports = ()


def run(argv: Sequence[str]) -> int:
    """Print one name a line."""
    from rewax.envs import registry

    options = parse(Options, argv, prog="rewax envs", description="List the environments.")
    import_modules(options.imports)
    print(*registry.list_envs(), sep="\n")
    return 0
