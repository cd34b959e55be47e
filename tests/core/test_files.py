"""A file that is written appears complete or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.core.files import check_folder, make_folder, replacing, write_text, write_whole


@pytest.mark.parametrize("durable", [False, True])
def test_the_new_file_replaces_the_old_one_at_the_end(tmp_path: Path, durable: bool) -> None:
    path = tmp_path / "file"
    path.write_text("old")
    with replacing(path, durable=durable) as part:
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_after_an_error_the_old_file_is_left_alone(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "file"
    path.write_text("old")
    with pytest.raises(type(error)), replacing(path) as part:
        part.write_text("half of the n")
        raise error
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_missing_folders_are_made(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "file"
    assert write_whole(path, "text", write_text) == path
    assert path.read_text() == "text"


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").mkdir()
    with pytest.raises(ConfigError, match="file: cannot be written"):
        write_whole(tmp_path / "file", "text", write_text)
    (tmp_path / "plain").write_text("")
    with pytest.raises(ConfigError, match=r"plain/x: cannot be written .*; choose another folder"):
        make_folder(tmp_path / "plain" / "x")
    for path in (tmp_path / "plain", tmp_path / "plain" / "x" / "y", Path("/proc/x")):
        with pytest.raises(ConfigError, match=r"cannot be written .*; choose another folder"):
            check_folder(path)
    check_folder(tmp_path / "a" / "b")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "plain"]
