"""One simulator, one scene, in a process of its own: prints a row as JSON.

python audit_worker.py MODULE VARIANT SCENE STARTS
"""

import dataclasses
import importlib
import json
import sys
import traceback
from types import ModuleType

import audit_scenes
from audit_protocol import NotSupported, NotTried, Row, audit, peak_memory_mb


def row_of(module: ModuleType, variant: str, scene: str, starts: int) -> Row:
    """Audits a scene in a simulator; what goes wrong is a row too."""
    empty = Row(simulator=variant, scene=scene, status="failed", version=module.VERSION, base_mb=peak_memory_mb())
    try:
        problem = module.build(variant, scene)
        numbers = audit(problem, audit_scenes.SCENES[scene].starts(starts))
    except NotSupported as error:
        return dataclasses.replace(empty, status="not supported", note=str(error))
    except NotTried as error:
        return dataclasses.replace(empty, status="not tried", note=str(error))
    except Exception as error:
        traceback.print_exc()
        return dataclasses.replace(empty, note=f"{type(error).__name__}: {str(error).strip().splitlines()[0][:200]}")
    return dataclasses.replace(empty, status="measured", how=problem.how, precision=problem.precision, **numbers)


def main() -> None:
    name, variant, scene, starts = sys.argv[1:]
    out, sys.stdout = sys.stdout, sys.stderr  # libraries print banners
    try:
        row = row_of(importlib.import_module(name), variant, scene, int(starts))
    except ImportError as error:
        traceback.print_exc()
        row = Row(simulator=variant, scene=scene, status="not installed", note=str(error))
    print(json.dumps(dataclasses.asdict(row)), file=out)


if __name__ == "__main__":
    main()
