"""Key files, the state file, and the command that makes a key."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gr_ros2.cli.main import run
from gr_ros2.core.errors import ConfigError
from gr_ros2.state.boots import BootFile
from gr_ros2.state.keys import new_key_file, read_key_file


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
    boots = [BootFile(path, clock, 7, sealed=False).boot for clock in (1000.5, 1000.9, 5.0, 2000.0, 0.0)]
    assert boots == [start << 32 | 7 for start in (1000, 1001, 1002, 2000, 2001)]
    path.unlink()
    assert BootFile(path, 3000.0, 7, sealed=False).boot >> 32 == 3000


def test_what_was_heard_is_remembered(tmp_path: Path) -> None:
    path = tmp_path / "state"
    BootFile(path, 1.0, 0, sealed=True).save(3, 77, 1234)
    assert BootFile(path, 1.0, 0, sealed=True).heard == {3: (77, 1234)}


def test_what_anybody_can_forge_does_not_count_with_a_key(tmp_path: Path) -> None:
    path = tmp_path / "state"
    BootFile(path, 1.0, 0, sealed=False).save(3, (1 << 64) - 1, 0)
    assert not BootFile(path, 1.0, 0, sealed=True).heard


def test_a_file_that_cannot_be_written_is_said_once_and_keeps_nobody_from_a_link(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "folder" / "state"
    file = BootFile(path, 1.0, 5, sealed=True)
    shutil.rmtree(path.parent)  # as good as a full disk: not even root can write there
    for _ in range(3):
        with pytest.raises(ConfigError, match="cannot be written"):
            file.save(3, 77, 1)
    assert len(caplog.messages) == 1
    path.parent.mkdir()
    file.save(3, 77, 2)
    assert "can be written again" in caplog.messages[-1]
    assert BootFile(path, 1.0, 6, sealed=True).heard == {3: (77, 2)}
    assert BootFile("/proc/gr_ros2/state", 9.0, 5, sealed=True).boot == 9 << 32 | 5


def test_a_second_process_is_told_who_uses_the_file(tmp_path: Path) -> None:
    path = tmp_path / "state"
    files = [BootFile(path, 1.0, 0, sealed=False) for _ in range(2)]
    code = "import sys; from gr_ros2.state.boots import BootFile; BootFile(sys.argv[1], 1.0, 0, sealed=False)"
    for file in files:
        other = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True, check=False)
        assert other.returncode
        assert f"process {os.getpid()} uses it" in other.stderr
        file.close()
    subprocess.run([sys.executable, "-c", code, path], check=True)
    with pytest.raises(ConfigError, match="is closed"):
        files[0].save(3, 77, 1)


def test_a_full_disk_leaves_no_part_of_a_key(tmp_path: Path) -> None:
    code = (
        "import resource, signal, sys; from gr_ros2.state.keys import new_key_file\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (40, 40))\n"
        "new_key_file(sys.argv[1])"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "key"], capture_output=True, text=True, check=False)
    assert "key: cannot be written (File too large)" in done.stderr
    assert not list(tmp_path.iterdir())


def test_a_key_by_mistake_is_not_repeated(capsys: pytest.CaptureFixture[str]) -> None:
    key = "0123456789abcdef" * 4
    with pytest.raises(ConfigError) as error:
        read_key_file(key)
    assert key not in str(error.value)
    assert (
        run(
            [
                "link",
                "--robot",
                "1",
                "--radio",
                "zmq",
                "--listen",
                "5555",
                "--peer",
                "127.0.0.1:5556",
                "--set",
                f"key={key}",
            ]
        )
        == 2
    )
    said = capsys.readouterr()
    assert "gr-ros2 key new" in said.err
    assert key not in said.err + said.out


@pytest.mark.parametrize(
    "text",
    [
        *["", "[]", '{"open": {}}', '{"boot": 1, "open": {"a": 2}}', '{"boot": 4294967295, "open": {}}'],
        *['{"boot": Infinity}', '{"boot": 1, "open": {"3": [5, 1e999]}}', pytest.param("[" * 100_000, id="deep")],
    ],
)
def test_a_damaged_state_file_is_an_error_and_no_new_start(tmp_path: Path, text: str) -> None:
    path = tmp_path / "state"
    path.write_text(text)
    with pytest.raises(ConfigError, match="state"):
        BootFile(path, 1.0, 0, sealed=False)
