"""Files outside ``docs/`` that belong to the site, and links to them.

A link such as ``../examples/train_sapo.py`` works where the repository is browsed. In the site the same files lie
beside the pages, so ``../`` goes.
"""

from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parent.parent.parent
PAGES = ("CHANGELOG.md", "CONTRIBUTING.md")


def on_files(files: Any, config: Any) -> Any:
    """Add pages of the top level, and examples."""
    examples = sorted(p for p in (ROOT / "examples").rglob("*") if p.suffix in (".py", ".ipynb"))
    for path in [*(ROOT / page for page in PAGES), *examples]:
        files.append(File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links as they are in the site."""
    if page.file.src_uri in PAGES:
        return markdown.replace("](docs/", "](")
    return markdown.replace("](../", "](") if "/" not in page.file.src_uri else markdown
