"""Links that are full: version 1 takes no air from what is new, so that no topic is older than with version 0."""

from __future__ import annotations

import pytest

from bench.saturated import SCENARIOS, TOLERANCE, paced_ratios, ratios, run

pytest.importorskip("gnuradio", reason="needs GNU Radio 3.10")


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("name", SCENARIOS)
def test_no_topic_is_older_than_with_version_0(name: str, loss: float) -> None:
    found = ratios(name, loss)
    assert found
    for topic, (ratio, note) in found.items():
        assert ratio <= TOLERANCE[loss], f"{topic}: {note}"


@pytest.mark.slow
def test_no_topic_is_older_where_packets_leave_as_soon_as_the_air_is_free() -> None:
    for topic, ratio in paced_ratios("six-topics-paced", 0.0, seeds=(1, 2)).items():
        assert ratio <= TOLERANCE[0.0], topic


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_a_repair_that_cannot_be_interrupted_delays_no_message(loss: float) -> None:
    (ratio,) = paced_ratios("paper-ofdm-paced", loss, seeds=(1, 2)).values()
    assert ratio <= TOLERANCE[loss]


@pytest.mark.slow
@pytest.mark.parametrize(("best_effort", "most"), [((), 1.25), (("odom",), TOLERANCE[0.2])])
def test_waiting_for_reports_makes_odometry_older_only_where_it_comes_in_order(
    best_effort: tuple[str, ...], most: float
) -> None:
    (ratio,) = paced_ratios("paper-ofdm-paced", 0.2, back=True, seeds=(1, 2), best_effort=best_effort).values()
    assert ratio <= most


@pytest.mark.parametrize("name", SCENARIOS[1:])
def test_a_full_link_repairs_nothing(name: str) -> None:
    _, air = run(name, 0.2, seconds=10.0)
    assert air["new"] > 0.9 * air["sent"]
    assert not air["repair"]


def test_a_full_link_that_nobody_answers_tells_its_topics_in_the_first_second() -> None:
    for seed in range(1, 9):
        topics, _ = run("six-topics-paced", 0.2, seconds=5.0, seed=seed)
        busy = [topic for topic in topics if topic.submitted > 100]
        assert busy
        assert all(topic.delivered > 5 for topic in busy)
