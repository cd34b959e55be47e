"""Bursts sample by sample and tag by tag, and a receiver that is deaf while its robot sends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pmt
import pytest
from gnuradio import blocks, gr
from hypothesis import given, settings
from hypothesis import strategies as st

from gr_ros2.phy.stream_times import TX_TIME, whole_and_rest
from gr_ros2.radio.bursts import LENGTH_TAG, Blanker, BurstLayout, BurstShaper

SIZES = st.integers(0, 5000)


def through(shaper: BurstShaper, samples: Sequence[complex], tags: Sequence[Any] = ()) -> tuple[Any, list[Any]]:
    """What comes out of a shaper, samples and tags."""
    graph = gr.top_block()
    out = blocks.vector_sink_c()
    graph.connect(blocks.vector_source_c(samples, False, 1, list(tags)), shaper, out)
    graph.run()
    return np.array(out.data()), list(out.tags())


def named(tags: Sequence[Any], name: str) -> dict[int, Any]:
    return {tag.offset: pmt.to_python(tag.value) for tag in tags if pmt.symbol_to_string(tag.key) == name}


@given(st.integers(1, 5000), SIZES, SIZES, st.integers(1, 4096))
def test_a_burst_holds_its_packet_and_is_no_longer_than_it_must_be(
    samples: int, lead: int, tail: int, multiple: int
) -> None:
    layout = BurstLayout(samples, lead, tail, multiple)
    needed = lead + samples + tail
    assert layout.total % multiple == 0
    assert needed <= layout.total < needed + multiple


@pytest.mark.parametrize("bursts", [1, 7, 300])
@pytest.mark.parametrize("layout", [BurstLayout(50), BurstLayout(50, 3, 4), BurstLayout(1000, 10, 1, 4096)])
def test_every_burst_is_padded_scaled_and_tagged(layout: BurstLayout, bursts: int) -> None:
    packets = np.exp(1j * np.arange(bursts * layout.samples)).astype(np.complex64)
    stray = gr.tag_utils.python_to_tag((3, pmt.intern("packet_len"), pmt.from_long(50), pmt.intern("x")))
    out, tags = through(BurstShaper(layout, 0.5, 1e6), packets.tolist(), [stray])
    shaped = out.reshape(bursts, layout.total)
    inside = slice(layout.lead, layout.lead + layout.samples)
    assert np.allclose(shaped[:, inside].ravel(), 0.5 * packets)
    assert np.count_nonzero(shaped) == len(packets)
    assert named(tags, LENGTH_TAG) == dict.fromkeys(range(0, bursts * layout.total, layout.total), layout.total)
    assert len(tags) == bursts


def test_a_part_of_a_packet_waits_for_the_rest() -> None:
    out, _ = through(BurstShaper(BurstLayout(50), 1.0, 1e6), [1j] * 149)
    assert len(out) == 100


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(1, 700), min_size=1, max_size=40), SIZES, st.integers(1, 100))
def test_bursts_of_different_lengths_are_told_apart_by_their_tags(lengths: list[int], lead: int, multiple: int) -> None:
    layout = BurstLayout(700, lead, 3, multiple)
    packets = [np.full(length, place + 1, np.complex64) for place, length in enumerate(lengths)]
    begins = np.cumsum([0, *lengths[:-1]]).tolist()
    tags = [
        gr.tag_utils.python_to_tag((begin, pmt.intern(LENGTH_TAG), pmt.from_long(length), pmt.intern("x")))
        for begin, length in zip(begins, lengths, strict=True)
    ]
    scale = 1 / (2 * len(lengths))
    out, found = through(BurstShaper(layout, scale, 1e6, tagged=True), np.concatenate(packets).tolist(), tags)
    totals = named(found, LENGTH_TAG)
    assert list(totals.values()) == [layout.total_of(length) for length in lengths]
    assert list(totals) == np.cumsum([0, *list(totals.values())[:-1]]).tolist()
    assert len(out) == sum(totals.values())
    for (begin, total), packet in zip(totals.items(), packets, strict=True):
        burst = out[begin : begin + total]
        assert np.allclose(burst[lead : lead + len(packet)], scale * packet)
        assert np.count_nonzero(burst) == len(packet)


def test_nothing_goes_beyond_full_scale() -> None:
    shaper = BurstShaper(BurstLayout(4), 2.0, 1e6)
    out, _ = through(shaper, [0.4, 1j, 3 + 3j, -0.5])
    assert np.allclose(out, [0.8, 1j, (1 + 1j) / np.sqrt(2), -1])
    assert shaper.clipped == 2


def test_a_burst_that_is_handed_over_ahead_is_on_the_air_at_its_time() -> None:
    shaper = BurstShaper(BurstLayout(1000), 1.0, 1e3, clock=lambda: 5.0, tagged=True)
    shaper.clock_offset = lambda: 0.0
    values = (pmt.intern(LENGTH_TAG), pmt.from_long(1000)), (TX_TIME, whole_and_rest(5.4))
    tags = [gr.tag_utils.python_to_tag((0, key, value, pmt.intern("x"))) for key, value in values]
    through(shaper, [1j] * 1000, tags)
    assert shaper.sent(5.0, 5.3) == []
    assert shaper.sent(5.5, 5.6) == [(pytest.approx(5.4), pytest.approx(6.4))]


def test_bursts_follow_each_other_on_the_air() -> None:
    now = 100.0
    shaper = BurstShaper(BurstLayout(1000), 1.0, 1e3, clock=lambda: now)
    through(shaper, [1.0] * 3000)
    assert shaper.sent(0, 1000) == [(100, 101), (101, 102), (102, 103)]
    assert shaper.sent(101.5, 101.6) == [(101, 102)]
    assert shaper.sent(0, 99.9) == []


@pytest.mark.parametrize(
    ("sent", "silent"),
    [
        ([], range(0)),
        ([(10.0, 11.0)], range(0)),
        ([(19.2, 19.4)], range(200, 500)),
        ([(18.0, 19.0)], range(100)),
        ([(19.9, 20.5)], range(900, 1000)),
        ([(19.2, 19.3), (19.6, 19.7)], [*range(200, 400), *range(600, 800)]),
    ],
)
def test_what_came_while_we_sent_is_blanked(sent: list[tuple[float, float]], silent: Sequence[int]) -> None:
    # 1000 samples at 1000 samples/s arrive at 20 s, so they are of 19 to 20 s; deaf for 0.1 s after each burst.
    blanker = Blanker(lambda begin, end: [t for t in sent if t[0] <= end and begin <= t[1]], 0.1, 1e3, lambda: 20.0)
    out = np.empty(1000, np.complex64)
    assert blanker.work([np.ones(1000, np.complex64)], [out]) == 1000
    deaf = np.flatnonzero(out == 0)
    assert set(silent) <= set(deaf)
    assert len(set(deaf) - set(silent)) <= 2 * len(sent)
    assert blanker.blanked == len(deaf)
    assert [n for low, high in blanker.blanked_in(0, 1000) for n in range(low, high)] == deaf.tolist()
    blanker.work([np.ones(1000, np.complex64)], [out])  # of the same time, so blanked at the same places of the next
    places = [n for low, high in blanker.blanked_in(0, 2000) for n in range(low, high)]
    assert places == [*deaf.tolist(), *(1000 + deaf).tolist()]
