"""The file of an airtime account: power cuts, full disks, wrong clocks, two links."""

from __future__ import annotations

import multiprocessing
import os
import resource
import signal
from pathlib import Path

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.link.airtime_limit import AirtimeLimit
from gr_ros2.settings.airtime import AirtimeRule
from gr_ros2.state.airtime import PAGE, AirtimeFile


class Times:
    """The clocks of a computer."""

    def __init__(self, wall: float = 1e9, uptime: float = 100.0, boot: str = "one") -> None:
        self.wall, self.uptime, self.boot = wall, uptime, boot

    def open(self, path: Path) -> AirtimeFile:
        return AirtimeFile(path, wall=lambda: self.wall, uptime=lambda: self.uptime, boot=self.boot)


def stored(path: Path, times: Times) -> None:
    file = times.open(path)
    file.save([(-5.0, 0.25), (10.0, 0.5)])
    file.close()


@pytest.mark.parametrize(
    ("later", "ago"),
    [
        (Times(wall=1e9 + 60, uptime=160.0), 60.0),
        (Times(wall=5e8, uptime=160.0), 60.0),  # the wall clock was set back
        (Times(wall=2e9, uptime=160.0), 60.0),  # the wall clock was set: the computer has run for 60 s
        (Times(wall=1e9 + 600, uptime=20.0, boot="two"), 600.0),
        (Times(wall=5e8, uptime=20.0, boot="two"), 20.0),  # without a battery for its clock
    ],
)
def test_what_was_spent_ages_by_the_time_that_has_passed_for_sure(tmp_path: Path, later: Times, ago: float) -> None:
    stored(tmp_path / "a", Times())
    assert [(round(u, 3), a) for u, a in later.open(tmp_path / "a").spent] == [
        (-5.0 - ago, pytest.approx(0.25, abs=2e-6)),
        (10.0 - ago, pytest.approx(0.5, abs=2e-6)),
    ]


@pytest.mark.parametrize("cut", range(0, 120, 7))
def test_a_power_cut_within_a_write_leaves_the_account_before(tmp_path: Path, cut: int) -> None:
    path, times = tmp_path / "a", Times()
    file = times.open(path)
    for number in range(3):
        file.save([(0.0, 1.0 + number)])
    before = path.read_bytes()
    file.save([(0.0, 4.0)])
    after = path.read_bytes()
    file.close()
    changed = next(n for n in range(len(after)) if before[n] != after[n]) // PAGE * PAGE
    path.write_bytes(after[: changed + cut] + before[changed + cut :])
    assert [round(airtime, 3) for _, airtime in times.open(path).spent] in ([3.0], [4.0])


def test_a_full_disk_takes_an_account_that_is_there(tmp_path: Path) -> None:
    path, times = tmp_path / "a", Times()
    stored(path, times)
    size = path.stat().st_size

    def full() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))  # no file grows any more
        file = times.open(path)
        for number in range(5):
            file.save([(0.0, float(number))])
        os._exit(0)

    assert _done_by(full) == 0
    assert [round(airtime, 3) for _, airtime in times.open(path).spent] == [4.0]


def test_a_file_that_cannot_be_made_is_said_and_tried_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where a folder should be")
    file = AirtimeFile(blocked / "a")
    limit = AirtimeLimit(AirtimeRule(0.01), 0.1, spent=file.spent, save=file.save)
    assert not limit.reserve(0.0, 0.1)
    assert not limit.reserve(5.0, 0.1)
    assert [record.levelname for record in caplog.records] == ["ERROR"]
    assert "nothing is sent until it can" in caplog.text
    blocked.unlink()
    assert limit.reserve(10.0, 0.1)
    assert "can be written again" in caplog.text


def test_kill_9_at_any_moment_forgets_nothing_that_was_sent(tmp_path: Path) -> None:
    path, sent = tmp_path / "a", tmp_path / "sent"
    rule = AirtimeRule(0.5, 100.0)
    total = 0.0
    for _ in range(3):

        def run() -> None:
            file = AirtimeFile(path)
            limit = AirtimeLimit(rule, 0.5, spent=file.spent, save=file.save)
            with sent.open("a") as said:
                now = 0.0
                while limit.reserve(now, 0.5):
                    limit.spend(now, 0.5)
                    said.write("x")
                    said.flush()
                    if said.tell() % 7 == 6:
                        os.kill(os.getpid(), signal.SIGKILL)

        assert _done_by(run) == -signal.SIGKILL
        total = 0.5 * len(sent.read_text())
        file = AirtimeFile(path)
        assert sum(airtime for _, airtime in file.spent) >= total
        file.close()
    assert total > 5


def test_two_links_do_not_share_an_account(tmp_path: Path) -> None:
    stored(tmp_path / "a", Times())
    first = Times().open(tmp_path / "a")
    with pytest.raises(ConfigError, match="another link of this robot uses it"):
        Times().open(tmp_path / "a")
    first.close()
    with pytest.raises(ConfigError, match="closed"):
        first.save([])
    Times().open(tmp_path / "a").close()


def test_a_file_of_something_else_is_refused_with_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("something else")
    for _ in range(2):  # it does not keep the file that it refuses
        with pytest.raises(ConfigError, match="delete it when this robot has sent nothing") as refused:
            AirtimeFile(tmp_path / "a")
        assert refused.value


def test_an_account_that_cannot_be_opened_is_not_forgotten(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()  # what not even root can open
    with pytest.raises(ConfigError, match="what was sent would be forgotten; let this user write it"):
        AirtimeFile(tmp_path / "a")


def _done_by(work: object) -> int | None:
    process = multiprocessing.get_context("fork").Process(target=work)  # type: ignore[arg-type]
    process.start()
    process.join()
    return process.exitcode
