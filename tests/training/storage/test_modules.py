"""The module of a run is imported from where it was, and another of the same name is refused."""

import sys

import pytest

from rewax.training.storage.modules import import_recorded


@pytest.fixture
def other(tmp_path, monkeypatch):
    """A folder of another project, which comes first."""
    for name in ("twin", "merged.part"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    folder = tmp_path / "other"
    folder.mkdir()
    (folder / "twin.py").write_text("where = 'other'\n")
    monkeypatch.setattr(sys, "path", [str(folder), *sys.path])
    return folder


def stored(name, folder):
    return {"env": "NotRegistered", "agent": "sapo", "imports": [{"name": name, "folder": str(folder)}]}


def home(tmp_path, name):
    folder = tmp_path / name
    folder.mkdir()
    (folder / "twin.py").write_text("where = 'own'\n")
    return folder


def test_another_projects_module_is_refused(tmp_path, other):
    own = home(tmp_path, "own")
    with pytest.raises(ValueError, match=rf"in {own}, but that in {other} would be imported: rename one .* --import"):
        import_recorded(stored("twin", own), tmp_path / "run")
    assert "twin" not in sys.modules
    import_recorded(stored("twin", other), tmp_path / "run")
    assert sys.modules["twin"].where == "other"


def test_an_installed_module_may_lie_elsewhere_in_another_environment(tmp_path, other):
    import_recorded(stored("twin", home(tmp_path, "site-packages")), tmp_path / "run")
    assert sys.modules["twin"].where == "other"


def test_parts_of_a_package_in_several_folders_are_merged(tmp_path, other):
    (other / "merged").mkdir()
    own = home(tmp_path, "own")
    (own / "merged").mkdir()
    (own / "merged" / "part.py").write_text("where = 'own'\n")
    import_recorded(stored("merged.part", own), tmp_path / "run")
    assert sys.modules["merged.part"].where == "own"
