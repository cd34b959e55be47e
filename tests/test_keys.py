"""Key files, the state file, and the command that makes a key."""

from __future__ import annotations

from pathlib import Path

import pytest

from gr_ros2.boots import BootFile
from gr_ros2.cli.main import run
from gr_ros2.errors import ConfigError
from gr_ros2.keys import new_key_file, read_key_file


def test_a_new_key_is_its_owners_and_no_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert [run(["key", "new", str(tmp_path / name)]) for name in "ab"] == [0, 0]
    keys = [read_key_file(tmp_path / name) for name in "ab"]
    assert [len(key) for (key,) in keys] == [32, 32]
    assert keys[0] != keys[1]
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o600
    capsys.readouterr()
    assert run(["key", "new", str(tmp_path / "a")]) == 2
    assert "never overwritten" in capsys.readouterr().err
    assert read_key_file(tmp_path / "a") == keys[0]


def test_a_file_that_others_may_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "key"
    new_key_file(path)
    for mode in (0o640, 0o604, 0o620, 0o602):
        path.chmod(mode)
        with pytest.raises(ConfigError, match="chmod 600"):
            read_key_file(path)


@pytest.mark.parametrize(("text", "said"), [("", "no key"), ("ab\n", ":1: not 64"), ("#\nxyz", ":2: not 64")])
def test_what_is_no_key_is_refused_by_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "key"
    path.touch(0o600)
    path.write_text(text)
    with pytest.raises(ConfigError, match=said):
        read_key_file(path)


def test_several_keys_are_read_in_order(tmp_path: Path) -> None:
    path = tmp_path / "key"
    path.touch(0o600)
    path.write_text(f"# new\n{'ab' * 32}\n\n{'cd' * 32}  # old\n")
    assert read_key_file(path) == (b"\xab" * 32, b"\xcd" * 32)


def test_boot_numbers_grow_whatever_the_clock_does(tmp_path: Path) -> None:
    path = tmp_path / "state"
    boots = [BootFile(path, clock).boot for clock in (1000.5, 1000.9, 5.0, 2000.0, 0.0)]
    assert boots == [1000, 1001, 1002, 2000, 2001]
    path.unlink()
    assert BootFile(path, 3000.0).boot == 3000


def test_what_was_heard_is_remembered(tmp_path: Path) -> None:
    path = tmp_path / "state"
    BootFile(path, 1.0).save(3, 77, 1234)
    assert BootFile(path, 1.0).heard == {3: (77, 1234)}


@pytest.mark.parametrize(
    "text", ["", "[]", '{"boot": 1}', '{"boot": 1, "heard": {"a": 2}}', '{"boot": 4294967295, "heard": {}}']
)
def test_a_damaged_state_file_is_an_error_and_no_new_start(tmp_path: Path, text: str) -> None:
    path = tmp_path / "state"
    path.write_text(text)
    with pytest.raises(ConfigError, match="state"):
        BootFile(path, 1.0)
