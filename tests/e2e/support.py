"""What the whole-path tests share: scenarios on DDS domains nobody uses, and the bag of a run."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from gr_ros2.link.fates import arrived
from gr_ros2.middleware.bag_files import read_bag
from gr_ros2_lab.record.result import Result
from gr_ros2_lab.run.runner import DELIVERED_BAG
from gr_ros2_lab.run.scenario import Scenario, load_scenario
from tests.domains import free_domains
from tests.middleware.support import same

DDS_PADDING = 3
"""Zeros DDS may put behind a message."""
COMMAND = (sys.executable, "-m", "gr_ros2.cli")


def on_free_domains() -> list[str]:
    """Overrides that put the ends of a link on two unused domains."""
    sending, receiving = free_domains()
    return [f"robots.0.graph.domain_id={sending}", f"robots.1.graph.domain_id={receiving}"]


def scenario(name: str | Path, *overrides: str, duration_s: float | None = None, seed: int | None = None) -> Scenario:
    return load_scenario(name, [*on_free_domains(), *overrides], duration_s=duration_s, seed=seed)


def set_options(overrides: Sequence[str]) -> list[str]:
    """The same as arguments of the command."""
    return [word for override in overrides for word in ("--set", override)]


def check_books(result: Result) -> None:
    """Every message has exactly one fate, and none is corrupt."""
    assert result.topics
    for topic in result.topics:
        assert sum(topic.ledger.values()) == topic.sent, topic
        assert arrived(topic.ledger) == topic.delivered
        assert topic.corrupt == 0
    assert result.packets["crc_failed"] == result.packets["malformed"] == 0


def check_complete(result: Result) -> None:
    """Everything sent was delivered, unaltered."""
    check_books(result)
    for topic in result.topics:
        assert topic.sent > 0, topic.topic
        assert topic.ledger == {"delivered": topic.sent}
        assert topic.pdr == 1.0


def delivered_bag(out: Path, topic: str) -> list[bytes]:
    return [message.payload for message in read_bag(out / DELIVERED_BAG, [topic])]


def check_identical(received: Sequence[bytes], sent: Sequence[bytes]) -> None:
    """The same messages in the same order, up to the zeros DDS may add."""
    assert len(received) == len(sent)
    altered = [number for number, pair in enumerate(zip(received, sent, strict=True)) if not same(*pair, DDS_PADDING)]
    assert altered == []
