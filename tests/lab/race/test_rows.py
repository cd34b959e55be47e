from __future__ import annotations

import zlib
from dataclasses import replace

import pytest

from gr_ros2.codecs.messages import IMAGE
from gr_ros2.core.errors import ConfigError, RunError
from gr_ros2_lab.race.links import LinkLog, LinkReport
from gr_ros2_lab.race.measure import RaceStream, check_outage, measure
from gr_ros2_lab.race.race_settings import RaceSettings, check
from gr_ros2_lab.race.rows import BLOB, ROWS, blob, number_of, picture, quality_db
from gr_ros2_lab.race.runner import run_race
from tests.lab.race.support import needs_namespaces
from tests.lab.race.test_measure import IDENTITY, log, observed
from tests.lab.race.test_race_settings import text

OUTAGE = (10.5, 12.25)


def numbers(heard: list[tuple[float, bytes]], **changes: object) -> object:
    seen = replace(observed(heard, log((10.0, 7, 0.1), (11.0, 100, 0.1), (12.5, 50, 0.1))), **changes)  # type: ignore[arg-type]
    return measure(seen, contender="gr-ros2", load=1.0, loss=0.0, sample_rate=1e5, row="outage-5")


def test_what_goes_beside_the_odometry_cannot_be_compressed_and_is_the_same_each_time() -> None:
    one = blob(0, 10_000)
    assert len(zlib.compress(one, 9)) > 10_000
    assert one == blob(0, 10_000) != blob(1, 10_000)
    assert [topic.type_name for topic in ROWS["late"].topics("dds")] == [BLOB] * 5
    assert len(list(ROWS["late"].offers("zenoh", 1.0))) == 5


def test_a_camera_shows_the_same_pictures_to_all_and_each_is_known_by_its_stamp() -> None:
    for stack, least in (("gr-ros2", 60.0), ("dds", 25.0)):
        offers = list(ROWS["camera"].offers(stack, 0.5))
        assert [number_of(offer.payload) for offer in offers] == [0, 1, 2, 3, 4]
        assert quality_db(3, offers[3].payload) > least
        assert quality_db(0, offers[4].payload) < quality_db(4, offers[4].payload)
    assert len(picture(0, compressed=True)) < 0.1 * len(picture(0, compressed=False))
    assert ROWS["camera"].topics("gr-ros2")[0].type_name == IMAGE


def test_numbers_of_an_outage() -> None:
    heard = [(10.25, text(0)), (12.375, text(1)), (12.75, text(2)), (13.125, text(3))]
    found = numbers(heard, outage=OUTAGE)
    assert found.fresh_after == pytest.approx(0.875)  # type: ignore[attr-defined]  # that of 13; the others are old
    assert found.lost == 0  # type: ignore[attr-defined]
    assert found.bytes_until_fresh == 150  # type: ignore[attr-defined]
    never = numbers(heard[:3], outage=OUTAGE)
    assert (never.fresh_after, never.bytes_until_fresh, never.lost) == (None, None, 1)  # type: ignore[attr-defined]


def test_an_outage_that_was_none_is_an_error() -> None:
    air = LinkReport(LinkLog(), LinkLog(), {"on_air": 3})
    early, within = [(10.75, text(0))], [(11.5, text(1))]
    check_outage(OUTAGE, RaceStream(IDENTITY, [10.0], early), air)
    for heard, drops in ((within, 3), (early, 0)):
        with pytest.raises(RunError, match=r"outage of 1\.8 s was none"):
            check_outage(OUTAGE, RaceStream(IDENTITY, [10.0], heard), replace(air, drops={"on_air": drops}))


def test_numbers_of_who_joined_late_and_of_what_went_beside() -> None:
    beside = RaceStream(IDENTITY, [9.0, 11.0, 11.0, 11.0], [(12.5, text(0)), (12.0, text(1))])
    found = numbers([(11.5, text(1)), (12.5, text(2))], began=10.5, late=True, beside=[beside])
    assert (found.sent, found.delivered) == (3, 2)  # type: ignore[attr-defined]
    assert found.first_message == pytest.approx(1.0)  # type: ignore[attr-defined]
    assert (found.beside_delivered, found.beside_done) == (0.5, None)  # type: ignore[attr-defined]
    whole = replace(beside, t_sent=beside.t_sent[:2])
    assert numbers([], began=10.5, beside=[whole]).beside_done == pytest.approx(2.0)  # type: ignore[attr-defined]
    used = numbers([(11.5, text(1)), (12.5, text(2))], processor_s=(0.25, 0.5))
    assert (used.processor_per_message, used.processor_programs) == (0.375, 0.125)  # type: ignore[attr-defined]


def test_a_row_is_of_two() -> None:
    with pytest.raises(ConfigError, match="row = 'late': of a race of two"):
        check(RaceSettings(row="late", robots=3, peers=("gr-ros2",)))


@pytest.mark.slow
@pytest.mark.real_time
@needs_namespaces
@pytest.mark.parametrize("name", ["outage-5", "late"])
def test_a_short_race_of_a_row(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    row = ROWS[name]
    short = replace(row, begin_s=0.5, outage_s=min(1.0, row.outage_s), latched=row.latched and (9000,))
    monkeypatch.setitem(ROWS, name, short)
    settings = RaceSettings(row=name, peers=("gr-ros2-latest",), load=(0.5,), loss=(0.0,), duration_s=3.0)  # type: ignore[arg-type]
    race = run_race(settings)
    assert race.error is None
    (cell,) = race.cells
    assert cell.matched
    assert cell.first_message is not None
    assert cell.processor_per_message is not None
    if short.late:
        assert cell.sent < 105 - 14  # what was sent before it joined does not count
        assert (cell.beside_delivered, cell.fresh_after) == (1.0, None)
        assert cell.beside_done is not None
    else:
        assert cell.lost is not None
        assert cell.fresh_after is not None
        assert 25 <= cell.lost <= 45  # those of a second
        assert cell.drops["on_air"] > 0
