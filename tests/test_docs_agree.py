"""The documentation agrees with the code and with the results."""

import csv
import json
import re
import runpy

import numpy as np
import pytest
from doc_pages import ROOT
from matplotlib.colors import to_rgb
from PIL import Image

import rewax
from rewax.cli.main import COMMANDS
from rewax.training.storage.description import plain
from rewax.training.suites.suite import read_suite
from rewax.viz.curves import CURVE_COLORS

ENVS = rewax.list_envs()
"""Before any test registers one of its own."""


def test_the_page_of_commands_has_a_section_for_each():
    sections = re.findall(r"^## ([a-z]+)$", (ROOT / "docs/command_line.md").read_text(), re.MULTILINE)
    assert sorted(sections) == sorted(COMMANDS)


def test_links_of_the_top_level_lead_somewhere():
    """Those within ``docs/`` are checked by ``mkdocs build --strict``."""
    for page in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"):
        links = re.findall(r"\]\(([^)#]+)(?:#([^)]+))?\)", (ROOT / page).read_text())
        assert len(links) > 5, page
        for path, anchor in links:
            target = ROOT / path
            assert path.startswith("http") or target.is_file(), (page, path)
            if anchor and not path.startswith("http"):
                titles = re.findall(r"^#+ (.*)$", target.read_text(), re.MULTILINE)
                assert anchor in [re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles], anchor


def test_pages_that_code_names_are_there():
    named = set()
    for folder in ("rewax", "benchmarks", "tests", "examples"):
        for path in (ROOT / folder).rglob("*.py"):
            named |= set(re.findall(r"\bdocs/[\w/]+\.md\b", path.read_text()))
    assert len(named) > 10 and not [page for page in named if not (ROOT / page).is_file()]


def test_files_that_pages_name_are_there():
    file = re.compile(r"(?<![\w/.])(?:tests|benchmarks|examples|docs)/[\w/]+\.(?:py|md|sh)\b")
    top = (ROOT / page for page in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md"))
    named = {
        (page.name, path) for page in [*(ROOT / "docs").rglob("*.md"), *top] for path in file.findall(page.read_text())
    }
    assert len(named) > 100 and not [(page, path) for page, path in named if not (ROOT / path).is_file()]


def test_units_page_has_the_right_table():
    up = {"x": 0, "y": 1, "z": 2}
    rows = re.findall(
        r"^\| (`\w+`(?:, `\w+`)*) \| ([xyz]) \|(.*)\|$", (ROOT / "docs/units.md").read_text(), re.MULTILINE
    )
    found = []
    for names, axis, rest in rows:
        gravity, steps, density, observation = (cell.strip() for cell in rest.split("|"))
        for name in re.findall(r"`(\w+)`", names):
            paper, small = (rewax.make(name, scale=scale) for scale in ("paper", "small"))
            scene = getattr(small, "scene", None)
            assert np.argmax(small.up) == up[axis], name
            pull = (small.model if scene is None else scene).gravity
            assert float(np.linalg.norm(pull)) == pytest.approx(float(gravity)), name
            times = [1e3 * env.control_dt for env in (paper, small)]
            assert times == pytest.approx([float(time) for time in steps.split("/")], abs=0.005), name
            shapes = {
                key: tuple(map(int, shape.split(", "))) for key, shape in re.findall(r"`(\w+)` \((.*?)\)", observation)
            }
            assert shapes == {key: spec.shape for key, spec in small.observation_spec.items()}, name
            material = getattr(scene, "material", None)
            if material is not None:
                parts = material if isinstance(material, tuple) else (material,)
                assert [float(part.density) for part in parts] == [float(d) for d in density.split(", ")], name
            found.append(name)
    assert sorted(found) == ENVS


@pytest.mark.parametrize(
    ("suite", "page"),
    [
        ("small", "small_suite"),
        ("ablations", "ablations"),
        ("ablations_paper", "ablations"),
        ("paper", "results"),
        ("paper_stale_mass", "results"),
        ("thin", "../cloth_tasks"),
    ],
)
def test_the_page_of_a_suite_shows_its_results(suite, page):
    """Fill it with ``benchmarks/suite_page.py`` after ``rewax bench``."""
    names = runpy.run_path(str(ROOT / "benchmarks" / "suite_page.py"))
    folder, page = ROOT / "docs" / "suites" / suite, (ROOT / "docs" / "measured" / f"{page}.md").resolve()
    text = page.read_text()
    assert (
        names["filled"](text, read_suite(suite), folder, page) == text and f"| {read_suite(suite).tasks[0]} |" in text
    )
    assert (folder / "table.md").read_text() in text
    options = json.loads((folder / "suite.json").read_text())  # with others `rewax bench` does not go on here
    assert {name: plain(getattr(read_suite(suite), name)) for name in options} == options
    table = list(csv.DictReader((folder / "curves.csv").read_text().splitlines()))
    for picture in folder.glob("*.png"):  # its curves must be told apart, however small the file was made
        image = Image.open(picture).convert("RGB")
        shades = np.array([color for _, color in image.getcolors(image.width * image.height)]) / 255.0
        drawn = {row["algorithm"] for row in table if row["task"] == picture.stem}
        for name, color in zip(read_suite(suite).algorithms, CURVE_COLORS, strict=False):
            distance = np.abs(shades - to_rgb(color)).max(axis=1).min()
            assert name not in drawn or distance < 0.06, (picture.name, name)


def test_the_pages_of_tasks_show_their_rows():
    """``benchmarks/gallery.py`` writes the tables of ``docs/tasks/results.csv``; those of the suite are written by hand."""
    earned = runpy.run_path(str(ROOT / "benchmarks" / "gallery.py"))["earned"]
    seeds: dict[str, list[dict[str, str]]] = {}
    for row in csv.DictReader((ROOT / "docs" / "tasks" / "results.csv").read_text().splitlines()):
        seeds.setdefault(row["env"], []).append(row)
    tables = {name: "\n".join(earned(rows)) for name, rows in seeds.items()}
    thin = list(csv.DictReader((ROOT / "docs" / "suites" / "thin" / "results.csv").read_text().splitlines()))
    for name in read_suite("thin").tasks:
        kinds = {(row["algorithm"], row["seed"]): row for row in thin if row["task"] == name}
        cells = [
            f"| {seed} | {float(row['sampled']):.1f} | {float(row['deterministic']):.1f} | {float(row['success']):.0%} |"
            for (algorithm, seed), row in kinds.items()
            if algorithm == "sapo"
        ]
        levels = [f"{float(kinds[level, '0']['sampled']):.1f}" for level in ("no action", "random actions")]
        tables[name] = "\n".join(f"{cell} {' | '.join(levels)} |" for cell in cells)
    assert sorted(tables) == ENVS
    assert not [name for name, table in tables.items() if table not in (ROOT / f"docs/tasks/{name}.md").read_text()]


def test_everything_that_the_index_of_formulas_names_is_there():
    rows = re.findall(
        r"^\| [^|]+ \| `(rewax/[\w/.]+)` \| (.*?) \|$", (ROOT / "docs/where.md").read_text(), re.MULTILINE
    )
    assert len(rows) > 30
    for path, names in rows:
        source = (ROOT / path).read_text()
        for name in re.findall(r"`(\w+)`", names):
            assert re.search(rf"^(def|class) {name}\b", source, re.MULTILINE), (path, name)
