"""Tables and curves of a suite's results, on a page of the documentation.

    rewax bench small --out docs/suites/small --devices 1     # continues where the results end
    python benchmarks/suite_page.py docs/suites/small docs/measured/small_suite.md

Draws nothing anew but what ``results.csv`` and ``curves.csv`` in that folder say. The page keeps its text; what stands
between the two markers of the suite is replaced.
"""

import dataclasses
import os
from pathlib import Path

import tyro
from PIL import Image

from rewax.training import Suite, read_suite
from rewax.training.suites.runs import rows
from rewax.training.suites.tables import markdown, write_results

FEW_COLORS = {"colors": 256, "method": Image.Quantize.MAXCOVERAGE, "dither": Image.Dither.NONE}
"""Of a picture: a quarter of the bytes, and its curves can still be told apart."""


@dataclasses.dataclass(frozen=True)
class Args:
    """Options of this page."""

    folder: tyro.conf.Positional[Path]
    page: tyro.conf.Positional[Path]


def filled(text: str, suite: Suite, folder: Path, page: Path) -> str:
    """The page's text with the results of a suite."""
    begin, end = f"<!-- results of {suite.name} -->\n", f"<!-- end of {suite.name} -->\n"
    head, rest = text.split(begin)
    return f"{head}{begin}{results(suite, folder, page)}{end}{rest.split(end)[1]}"


def results(suite: Suite, folder: Path, page: Path) -> str:
    """What stands between the markers."""
    pictures = [folder / f"{task}.png" for task in suite.tasks]
    curves = [f"![{p.stem}: learning curves]({os.path.relpath(p, page.parent)})" for p in pictures if p.is_file()]
    return f"{markdown(suite, rows(suite, folder))}\n{chr(10).join(curves)}\n"


def main(args: Args) -> int:
    suite = read_suite(args.folder.name)
    print("\n".join(write_results(suite, rows(suite, args.folder), args.folder)))
    for picture in args.folder.glob("*.png"):
        Image.open(picture).convert("RGB").quantize(**FEW_COLORS).save(picture, optimize=True)
    args.page.write_text(filled(args.page.read_text(), suite, args.folder, args.page))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Args, description=__doc__)))
