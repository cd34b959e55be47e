"""What repair delivers, against what is promised: endpoints over a slotted channel, beside the ideal (bench.repair)."""

from __future__ import annotations

from statistics import mean
from typing import Any

import pytest

from bench.repair import BUSY_HZ, genie, run
from gr_ros2.link.v1.sealing import Keys
from tests.link.v1.air import KEY

SEED = 2


@pytest.mark.parametrize(
    ("loss", "burst", "least", "age", "p99"),
    [
        (0.0, 1.0, (1.0, 1.0), 1.03, 0.030),
        (0.05, 1.0, (0.999, 1.0), 1.03, 0.060),
        (0.1, 1.0, (0.999, 1.0), 1.03, 0.080),
        (0.2, 1.0, (0.998, 0.999), 1.05, 0.120),
        (0.27, 1.0, (0.995, 0.998), 1.08, None),
        (0.2, 3.0, (0.97, 0.98), None, None),
    ],
)
def test_odometry(loss: float, burst: float, least: tuple[float, float], age: float | None, p99: float | None) -> None:
    case: dict[str, Any] = {"loss": loss, "burst": burst, "seed": SEED}
    ideal = genie(**case, in_order=True)
    for back, wanted in zip((None, loss), least, strict=True):
        outcome = run(back=back, **case)
        assert outcome.pdr[0] >= wanted
        assert age is None or outcome.age <= age * ideal.age
        assert p99 is None or outcome.p99 <= p99


def test_thrifty() -> None:
    outcome = run(loss=0.2, back=0.2, repair="thrifty", seed=SEED)
    assert outcome.pdr[0] >= 0.998
    assert outcome.p99 <= 0.250
    assert outcome.packets <= 1.65
    quiet = run(loss=0.0, back=0.0, repair="thrifty", seed=SEED)
    assert quiet.air["repair"] == 0


@pytest.mark.parametrize(("back", "least"), [(None, 0.97), (0.2, 0.995)])
def test_a_link_with_few_idle_slots(back: float | None, least: float) -> None:
    """55 messages/s on 75 packets/s. One run differs from the next by 2 %."""
    assert mean(run(hz=BUSY_HZ, loss=0.2, back=back, seed=seed).pdr[0] for seed in range(4)) >= least


@pytest.mark.parametrize("receivers", [1, 5])
def test_messages_of_15_packets(receivers: int) -> None:
    """In a quarter of the runs the slowest message in a hundred waits for the next one: 0.6 s, else 0.34."""
    runs = [run(hz=3, size=724, loss=0.2, receivers=receivers, seconds=60, seed=seed) for seed in range(4)]
    assert min(min(outcome.pdr) for outcome in runs) >= 0.999
    assert mean(outcome.p99 for outcome in runs) <= 0.450


@pytest.mark.parametrize("back", [None, 0.2])
def test_five_receivers(back: float | None) -> None:
    assert min(run(loss=0.2, back=back, receivers=5, seed=SEED).pdr) >= 0.999


@pytest.mark.parametrize("back", [None, 0.2])
@pytest.mark.parametrize("size", [500_000, 1_000_000])
def test_large_messages(size: int, back: float | None) -> None:
    outcome = run(once=True, size=size, packet_len=1500, loss=0.2, back=back, tail=100, seed=SEED)
    assert outcome.pdr == [1.0]
    assert outcome.sent_until <= 1.35 * -(-size // 1480)


def test_sealed() -> None:
    outcome = run(loss=0.2, size=40, keys=Keys((KEY,), "encrypt"), seed=SEED)
    assert outcome.pdr[0] >= 0.998
