"""Media: the same schedule on both levels, what overlaps, and what the work depends on."""

from __future__ import annotations

import random
from collections import Counter
from math import sqrt

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy import PHY, Phy
from gr_ros2.settings.config import ChannelConfig
from gr_ros2_lab.medium import FixedPaths, Medium, RadioPath, Reception, make_medium
from gr_ros2_lab.medium.packets import PacketMedium

PACKET_LEN = 64


def phy(name: str = "ofdm", **options: object) -> Phy:
    made: Phy = PHY.load(name)(PACKET_LEN, 1e5, **options)
    return made


def between(robots: int, snr_db: float | None, heard: int | None = None) -> list[list[RadioPath]]:
    """Paths between all robots, or from each robot to the ``heard`` next ones in a circle."""
    steps = range(1, robots if heard is None else heard + 1)
    channels = [[ChannelConfig(snr_db=snr_db, seed=100 * one + step) for step in steps] for one in range(robots)]
    return [
        [RadioPath((one + step) % robots, channel) for step, channel in zip(steps, channels[one], strict=True)]
        for one in range(robots)
    ]


def media(paths: list[list[RadioPath]], of: Phy, *, shared: bool, seed: int = 0) -> dict[str, Medium]:
    phys = [of] * len(paths)
    return {
        time: make_medium(FixedPaths(paths), phys, samples=time == "samples", shared=shared, seed=seed)
        for time in ("packets", "samples")
    }


def received(medium: Medium, of: Phy, schedule: list[tuple[float, int]], seed: int = 0) -> list[Reception]:
    """What is received of random packets, each with its start in airtimes and its sender."""
    draw = random.Random(seed)
    airtime = of.airtime()
    for start, sender in schedule:
        medium.send(sender, draw.randbytes(PACKET_LEN), start * airtime, airtime)
    return list(medium.receptions((schedule[-1][0] + 2) * airtime))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "snrs_db"), [("ofdm", (4.5, 5.5, 7.0)), ("psk", (2.5, 3.5, 4.5)), ("gfsk", (0.0, 1.0, 2.0))]
)
def test_both_levels_lose_the_same_share_of_a_schedule_of_bursts(name: str, snrs_db: tuple[float, ...]) -> None:
    """Within the 99 % interval of the difference, the two points of the table included."""
    of, packets, measured = phy(name), 600, 1000
    between_both = []
    for snr_db in snrs_db:
        schedule = [(1.5 * number, 0) for number in range(packets)]
        counts = {
            time: len(received(medium, of, schedule))
            for time, medium in media([[RadioPath(1, ChannelConfig(snr_db=snr_db))], []], of, shared=False).items()
        }
        pdr = sum(counts.values()) / (2 * packets)
        spread = sqrt(max(pdr * (1 - pdr), 1 / packets) * (2 / packets + 1 / measured))
        assert abs(counts["packets"] - counts["samples"]) / packets < 2.58 * spread, (name, snr_db, counts)
        between_both.append(pdr)
    assert any(0.1 < pdr < 0.9 for pdr in between_both), "where it matters"


@pytest.mark.parametrize("time", ["packets", "samples"])
@pytest.mark.parametrize(("offset", "arrive"), [(0.5, False), (1.2, True)])
def test_packets_that_overlap_destroy_each_other(time: str, offset: float, arrive: bool) -> None:
    of = phy()
    paths = between(3, 11.0)
    medium = media(paths, of, shared=True)[time]
    heard = received(medium, of, [(0.0, 0), (offset, 1)])
    assert [reception.receiver for reception in heard] == ([1, 2, 2, 0] if arrive else [])
    if not arrive:
        assert medium.lost[0, 2] == medium.lost[1, 2] == {"collision": 1}
        assert medium.lost[0, 1] == medium.lost[1, 0] == {"sending": 1}, "who sends hears nothing"


@pytest.mark.parametrize("time", ["packets", "samples"])
def test_on_channels_of_their_own_robots_do_not_disturb_each_other(time: str) -> None:
    of = phy()
    heard = received(media(between(2, 11.0), of, shared=False)[time], of, [(0.0, 0), (0.5, 1)])
    assert [(reception.sent.sender, reception.receiver) for reception in heard] == [(0, 1), (1, 0)]
    assert [reception.snr_db for reception in heard] == [11.0, 11.0]


@pytest.mark.parametrize("time", ["packets", "samples"])
def test_the_stronger_of_two_bursts_may_survive(time: str) -> None:
    of = phy()
    paths = [[RadioPath(2, ChannelConfig(snr_db=30.0))], [RadioPath(2, ChannelConfig(snr_db=8.0))], []]
    heard = received(media(paths, of, shared=True)[time], of, [(0.0, 0), (0.3, 1)])
    assert [reception.sent.sender for reception in heard] == [0]
    if time == "packets":
        assert heard[0].sinr_db == pytest.approx(21.4, abs=0.1)


@pytest.mark.parametrize("stronger", [0, 1])
@pytest.mark.parametrize("offset", [0.0, 0.005, 0.3, 0.9])
def test_of_robots_that_send_equal_bytes_the_one_that_is_heard_is_named(stronger: int, offset: float) -> None:
    of = phy()
    snrs_db = [8.0, 8.0]
    snrs_db[stronger] = 32.0
    paths = [[RadioPath(2, ChannelConfig(snr_db=snr_db))] for snr_db in snrs_db]
    medium = media([*paths, []], of, shared=True)["samples"]
    airtime = of.airtime()
    for sender in (0, 1):
        medium.send(sender, bytes(PACKET_LEN), (1 + offset * sender) * airtime, airtime)
    heard = list(medium.receptions(4 * airtime))
    assert [(one.sent.sender, one.snr_db) for one in heard] == [(stronger, 32.0)]
    assert heard[0].packet.at == heard[0].sent.start
    assert medium.lost[1 - stronger, 2] == {"collision": 1}


def test_a_path_with_a_delay_receives_later() -> None:
    of = phy()
    paths = [[RadioPath(1, ChannelConfig(), delay_s=0.25)], []]
    medium = PacketMedium(FixedPaths(paths), [of] * 2)
    medium.send(0, bytes(PACKET_LEN), 0.0, 0.1)
    assert not list(medium.receptions(0.34))
    assert [reception.at for reception in medium.receptions(0.36)] == [pytest.approx(0.35)]


def test_the_work_for_a_packet_does_not_depend_on_robots_out_of_hearing() -> None:
    """Each robot hears four others; with twenty robots and with a hundred."""
    of = phy()

    def work(robots: int) -> Counter[str]:
        draw = random.Random(1)
        paths = between(robots, 11.0, heard=4)
        medium = PacketMedium(FixedPaths(paths), [of] * robots, shared=True)
        packets = 20 * robots
        schedule = sorted((draw.uniform(0, 200), number % robots) for number in range(packets))
        by_sender = dict.fromkeys(range(robots), 0.0)
        for number, (start, sender) in enumerate(schedule):  # one after the other at each robot
            schedule[number] = max(start, by_sender[sender]), sender
            by_sender[sender] = schedule[number][0] + 1
        received(medium, of, sorted(schedule))
        return Counter(examined=medium.examined, packets=packets)

    few, many = work(20), work(100)
    assert many["examined"] / many["packets"] == pytest.approx(few["examined"] / few["packets"], rel=0.05)


def test_stock_receivers_cannot_share_a_channel_at_samples() -> None:
    of = phy(detection_threshold="stock")
    with pytest.raises(ConfigError, match="set time to packets"):
        media(between(2, 11.0), of, shared=True)
