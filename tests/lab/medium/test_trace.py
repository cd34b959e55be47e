"""Channels that were measured over time: what is read, what is refused, and what crosses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2_lab.medium.trace import QUEUE_S, Capacity, MeasuredLosses, read_trace
from gr_ros2_lab.run.runner import run_scenario
from gr_ros2_lab.run.scenario import load_scenario, scenario_from

ODOM = str(Path(__file__).parents[3] / "gr_ros2/registries/odom.csv")


AT_ONCE = {"odom": {"reliability": "best_effort"}}
"""In order, a message would wait for what is lost."""


def written(folder: Path, text: str, name: str = "trace.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def scenario(trace: Path, **settings: Any) -> Any:
    values: dict[str, Any] = {"name": "measured", "registry": ODOM, "robots": [{"topics": AT_ONCE}, {"topics": []}]}
    values |= {
        "time": "packets",
        "phy": {"name": "direct"},
        "repair": "off",
        "duration_s": 20,
        "channel": {"trace": str(trace)},
    }
    return scenario_from({**values, **settings})


def arrived(chosen: Any) -> Any:
    (topic,) = run_scenario(chosen).result.topics
    return topic


def test_a_row_holds_until_the_next_and_the_trace_begins_again(tmp_path: Path) -> None:
    trace = read_trace(written(tmp_path, "\ufefft_s,snr_db,note\r\n100,1,a\r\n101,2,b\r\n103,3,c\r\n"))
    assert trace.snr_db is not None
    assert [float(trace.snr_db[trace.row(now)]) for now in (0, 0.99, 1, 2.9, 3, 4.4, 4.5, 5.6)] == [
        *(1, 1, 2, 2, 3, 3, 1, 2)
    ]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t_s,loss\n0,0\n1,nan\n", "line 3: loss = 'nan': write a finite number"),
        ("t_s,loss\n0,0\n1,\n", "line 3: loss = ''"),
        ("t_s,loss\n0,0\n1,inf\n", "line 3: loss = 'inf'"),
        ("t_s,loss\n0,0\n1,0\n\n1,0\n", "line 5: t_s = 1 after 1: time goes back or stands"),
        ("t_s,loss\n0,0\n2,0\n1,0\n", "line 4: t_s = 1 after 2: time goes back"),
        ("t_s,loss\n0,0\n1,0\n2,0\n30,0\n", "line 5: a gap of 28 s after t_s = 2, where rows are 1 s apart"),
        ("t_s,loss\n-1e308,0\n1e308,1\n", "line 2: t_s = -1e+308: not within"),
        ("t_s,loss\n0,0\n1,1.5\n", "line 3: loss = 1.5: not within 0..1"),
        ("t_s,capacity_bps\n0,0\n1,0\n", "not one packet"),
        ("t_s,loss\n0,0\n", "1 rows say nothing over time"),
        ("t_s,snr\n0,0\n1,0\n", "has no header of a trace; write t_s and one or more of"),
        ("", "has no header of a trace"),
        ("5\n3\n", "line 2: 3 after 5: time goes back"),
        ("5\nx\n", "line 2: 'x' is no time in ms"),
        ("0\n0\n", "ends at 0 ms"),
    ],
)
def test_a_trace_with_a_fault_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as refused:
        run_scenario(scenario(path))
    assert str(path) in str(refused.value)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        run_scenario(scenario(tmp_path / "no.csv"))
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="cannot be read"):
        run_scenario(scenario(tmp_path / "bytes.csv"))


@pytest.mark.parametrize("stairs", [False, True])
def test_bytes_pass_when_the_capacity_has_carried_them(stairs: bool) -> None:
    first = [] if stairs else [0.0]
    capacity = Capacity(np.array([*first, 1.0, 2.0, 4.0]), np.array([*first, 100.0, 200.0, 500.0]), stairs=stairs)
    for carried in (1.0, 100.0, 150.0, 499.0, 500.0, 501.0, 1234.0):
        at = capacity.when(carried)
        assert capacity.by(at + 1e-9) >= carried - 1e-6, "as much has passed by then"
        assert capacity.by(at - 1e-6) < carried, "and not before"


def test_packets_wait_in_a_queue_that_ends(tmp_path: Path) -> None:
    losses = MeasuredLosses(read_trace(written(tmp_path, "t_s,capacity_bps\n0,8000\n1,8000\n")))
    assert [losses.leaves(0.0, 500) for _ in range(5)] == [pytest.approx(t) for t in (0.5, 1.0, 1.5, 2.0)] + [None]
    assert losses.leaves(10.0, 500) == pytest.approx(10.5), "what was not used is lost"
    assert QUEUE_S == 2.0


def test_losses_follow_the_trace(tmp_path: Path) -> None:
    path = written(tmp_path, "t_s,loss\n" + "".join(f"{t},{float(5 <= t < 15)}\n" for t in range(20)))
    topic = arrived(scenario(path))
    assert topic.pdr == pytest.approx(0.5, abs=0.03)
    assert topic.age_s.peak == pytest.approx(10, abs=0.3)


def test_capacity_delays_what_it_does_not_carry_at_once(tmp_path: Path) -> None:
    """One opportunity of 1,500 bytes each 130 ms: no packet comes before the next."""
    path = written(tmp_path, "".join(f"{ms}\n" for ms in range(130, 2601, 130)), "uplink")
    topic = arrived(scenario(path))
    assert topic.pdr == 1
    assert topic.latency_s.max == pytest.approx(0.13, abs=0.02)
    assert topic.latency_s.p50 == pytest.approx(0.065, abs=0.02)


@pytest.mark.parametrize("time", ["packets", "samples"])
def test_levels_follow_the_trace(tmp_path: Path, time: str) -> None:
    """``channel.trace`` with SNRs, at packets and at samples."""
    path = written(tmp_path, "t_s,snr_db\n" + "".join(f"{t},{30 if t % 2 else -10}\n" for t in range(4)))
    phy = {"name": "psk", "sample_rate": 100e3}
    topic = arrived(scenario(path, phy=phy, time=time, duration_s=8, packet_len=128))
    assert topic.pdr == pytest.approx(0.5, abs=0.05)
    assert topic.age_s.peak == pytest.approx(1.1, abs=0.15)


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.parametrize("measured", ["loss", "snr_db", "capacity"])
def test_traces_act_in_real_time_as_in_simulated_time(tmp_path: Path, measured: str) -> None:
    """Good for the first of each two seconds; with a capacity, one opportunity each 130 ms."""
    if measured == "capacity":
        path = written(tmp_path, "".join(f"{ms}\n" for ms in range(130, 2601, 130)), "uplink")
    else:
        good, bad = {"loss": (0, 1), "snr_db": (30, -10)}[measured]
        path = written(tmp_path, f"t_s,{measured}\n" + "".join(f"{t},{bad if t % 2 else good}\n" for t in range(4)))
    phy = {"name": "psk", "sample_rate": 100e3} if measured == "snr_db" else {"name": "direct"}
    real, simulated = (
        arrived(scenario(path, phy=phy, packet_len=128, duration_s=6, time=time)) for time in ("real", "packets")
    )
    assert real.pdr == pytest.approx(simulated.pdr, abs=0.1)
    assert simulated.pdr == pytest.approx(1.0 if measured == "capacity" else 0.5, abs=0.1)
    if measured == "capacity":
        assert min(real.latency_s.p50, simulated.latency_s.p50) > 0.05  # half of the time between two opportunities


def test_each_path_may_have_a_trace_of_its_own(tmp_path: Path) -> None:
    path = written(tmp_path, "t_s,loss\n0,1\n1,1\n")
    chosen = scenario(path, channel={}, robots=2, paths=[{"from": 1, "to": 2, "trace": str(path)}])
    there, back = run_scenario(chosen).result.topics
    assert (there.pdr, back.pdr) == (0, 1)


@pytest.mark.parametrize(
    ("text", "settings", "said"),
    [
        ("t_s,snr_db\n0,1\n1,1\n", {}, "tells an SNR, which a phy without samples has not"),
        (
            "5\n",
            {"phy": {"name": "psk", "sample_rate": 1e5}},
            "tells a capacity, which this phy has by its own airtime",
        ),
        (
            "t_s,snr_db\n0,1\n1,1\n",
            {"phy": {"name": "psk", "sample_rate": 1e5}, "snr": 3},
            "channel.snr_db: follows from the trace",
        ),
    ],
)
def test_what_a_phy_does_not_have_is_refused(tmp_path: Path, text: str, settings: Any, said: str) -> None:
    path = written(tmp_path, text)
    snr = {"snr_db": settings.pop("snr")} if "snr" in settings else {}
    with pytest.raises(ConfigError, match=said):
        run_scenario(scenario(path, channel={"trace": str(path), **snr}, **settings))


def test_a_trace_lies_beside_its_scenario(tmp_path: Path) -> None:
    written(tmp_path, "t_s,loss\n0,1\n1,1\n")
    text = f"registry: {ODOM}\nrobots: 2\nphy: {{name: direct}}\ntime: packets\nchannel: {{trace: trace.csv}}\n"
    chosen = load_scenario(written(tmp_path, text, "trial.yaml"), [], duration_s=2)
    assert [topic.pdr for topic in run_scenario(chosen).result.topics] == [0, 0]
