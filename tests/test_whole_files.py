import errno
from pathlib import Path

import pytest

from rewax.whole_files import check_can_write, replacing


def test_a_reader_sees_the_old_file_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "new" / "result.json"
    with replacing(path) as unfinished:
        unfinished.write_text("old")
        assert not path.exists()
    with replacing(path) as unfinished:
        unfinished.write_text("ne")
        assert path.read_text() == "old"
        unfinished.write_text("new")
    assert path.read_text() == "new"
    assert list(path.parent.iterdir()) == [path]


def test_a_block_that_raises_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "result.json"
    path.write_text("old")
    with pytest.raises(OSError, match="full"), replacing(path) as unfinished:
        unfinished.write_text("ne")
        raise OSError("the disk is full")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_block_that_writes_nothing_is_an_error_and_keeps_the_old_file(tmp_path):
    path = tmp_path / "result.json"
    path.write_text("old")
    with pytest.raises(FileNotFoundError), replacing(path):
        pass
    assert path.read_text() == "old"


def test_a_disk_that_has_become_read_only_is_the_error(tmp_path, monkeypatch):
    def refused(self, *args, **kwargs):
        raise OSError(errno.EROFS, "Read-only file system", str(self))

    for name in ("replace", "unlink"):
        monkeypatch.setattr(Path, name, refused)
    with pytest.raises(OSError, match="Read-only file system") as caught, replacing(tmp_path / "a") as unfinished:
        unfinished.write_text("new")
    assert caught.value.__context__ is None


def test_two_at_once_do_not_meet(tmp_path):
    path = tmp_path / "video.mp4"
    with replacing(path) as first:
        with replacing(path) as second:
            first.write_text("first")
            second.write_text("second")
        assert path.read_text() == "second"
        assert first.suffix == second.suffix == ".mp4"
    assert path.read_text() == "first"
    assert list(tmp_path.iterdir()) == [path]


def test_whether_a_file_can_be_written_is_known_before(tmp_path):
    (tmp_path / "file").write_text("old")
    check_can_write(tmp_path / "file")
    check_can_write(tmp_path / "new" / "other")
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["file", "new"]
    assert (tmp_path / "file").read_text() == "old"
    with pytest.raises((NotADirectoryError, FileExistsError)):
        check_can_write(tmp_path / "file" / "below")
