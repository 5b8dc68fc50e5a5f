"""Files outside ``docs/`` that belong to the site, links to them, order of search results, and checks of the site.

A link such as ``../examples/train_sapo.py`` works where the repository is browsed. In the site the folder ``examples``
lies beside the pages, one level higher.
"""

import ast
import logging
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parent.parent.parent
PAGES = ("CHANGELOG.md", "CONTRIBUTING.md", "RELEASING.md", "SECURITY.md", "CODE_OF_CONDUCT.md")
MEASURED = ("measured/", "tasks/")
"""A search finds the manual before these."""
log = logging.getLogger("mkdocs.hooks.rewax")


def on_files(files: Any, config: Any) -> Any:
    """Add pages of the top level, and examples."""
    examples = sorted(path for path in (ROOT / "examples").rglob("*") if path.suffix in (".py", ".ipynb"))
    for path in [*(ROOT / page for page in PAGES), *examples]:
        files.append(File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links as they are in the site, and fences without what the tests read in them."""
    if page.file.src_uri.startswith(MEASURED):
        page.meta.setdefault("search", {})["boost"] = 0.5
    if page.file.src_uri in PAGES:
        return markdown.replace("](docs/", "](")
    up = "../" * page.file.src_uri.count("/")
    markdown = markdown.replace(f"]({up}../examples/", f"]({up}examples/")
    return re.sub(r"^(```\w+) \w+$", r"\1", markdown, flags=re.MULTILINE)


def on_post_build(config: Any) -> None:
    """Warn, which ``--strict`` makes an error, of public names that an API page lacks, and of remote scripts."""
    loaded = r'<script[^>]+src="https?:[^"]*"|<link rel="stylesheet" href="https?:[^"]*"'
    for element in re.findall(loaded, _built(config, "index.html")):
        log.warning(f"the site is read from disk, but {element} needs a network")
    pages = {page.stem: page.read_text() for page in sorted((ROOT / "docs" / "api").glob("*.md"))}
    shown = "".join(_built(config, f"api/{stem}.html") for stem in pages)
    source = "\n".join(pages.values())
    for init in sorted((ROOT / "rewax").rglob("__init__.py")):
        package = ".".join(init.parent.relative_to(ROOT).parts)
        for name in _public(init):
            if not re.search(rf'id="rewax[.\w]*\.{name}"', shown) and not re.search(
                rf"^(:::|##) .*\.{name}$", source, flags=re.MULTILINE
            ):
                log.warning(f"{package}.{name} is public, but no page of docs/api shows it")


def _built(config: Any, page: str) -> str:
    return (Path(config.site_dir) / page).read_text()


def _public(init: Path) -> list[str]:
    """What ``__all__`` of a package lists."""
    for node in ast.parse(init.read_text()).body if init.is_file() else ():
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            return ast.literal_eval(node.value)
    return []
