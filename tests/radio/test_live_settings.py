"""Settings of a running link that change: whom a topic is for, by one name for ROS parameters and the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from gnuradio import gr

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import Qos
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.radio.live_settings import LiveSettings
from gr_ros2.settings.fields import settings_of
from gr_ros2.settings.robot import RobotConfig
from tests.domains import free_domains
from tests.gr.ends import link
from tests.gr.test_found_topics import text
from tests.middleware.support import STRING
from tests.waiting import wait_for

TO = "topics.goal.to"


@pytest.mark.parametrize("found", [False, True], ids=["registry", "found on the graph"])
def test_a_topic_is_for_one_robot_after_the_other(tmp_path: Path, found: bool) -> None:
    domains = free_domains(3)
    common: dict[str, Any] = {"graph_middleware": "memory"}
    (tmp_path / "topics.csv").write_text(f"goal,{STRING}\n")
    topics = {"topics": ["goal"]} if found else {"registry": str(tmp_path / "topics.csv")}
    one = link(robot=1, direction="send", graph_domain_id=domains[0], graph_namespace="", **topics, **common)
    others = [
        link(robot=robot, direction="receive", graph_domain_id=domain, **common)
        for robot, domain in zip((2, 3), domains[1:], strict=True)
    ]
    source, sinks = one.source, [other.sink for other in others]
    near, *far = (MemoryMiddleware(domain_id=domain) for domain in domains)
    heard: list[list[bytes]] = [[], []]
    for graph, payloads in zip(far, heard, strict=True):
        graph.subscribe("/rx_robot_1/goal", STRING, Qos("reliable", "volatile", 0), payloads.append)
    publisher = near.advertise("/goal", STRING, Qos("reliable", "volatile", 0))
    top = gr.top_block()
    for sink in sinks:
        top.msg_connect((source, "pdus"), (sink, "pdus"))
    live = LiveSettings(source, sinks[0])
    said = live.change(TO, 2)  # also of a topic that the graph does not have yet
    assert said == f"{TO} = 2" + "; no topic goal is sent now, it waits for one; nothing is sent yet" * found
    top.start()
    try:
        wait_for(publisher.matched, "the source's subscription")
        said: list[list[bytes]] = [[], []]
        for number, to in enumerate((2, 3, "auto", 3, 2)):
            assert live.change(TO, to) == f"{TO} = {to}"
            publisher.publish(text(number))
            for place, robot in enumerate((2, 3)):
                said[place] += [text(number)] * (to in (robot, "auto"))
            wait_for(lambda: heard == said, f"{said}, not {heard}")
        with pytest.raises(ConfigError, match="goal: codec cannot change while running; these can: to, "):
            source.set_topics({"goal": {"codec": "zstd"}})
        with pytest.raises(ConfigError, match="to = 256"):
            live.change(TO, 256)
        with pytest.raises(
            ConfigError, match=r"^packet_len cannot change while the link runs; these can: packet_rate, \w+"
        ):
            live.change("packet_len", 100)
        live.change("topics./goal.weight", 2.0)
        if found:
            said = live.change("topics.gaol.to", 2)
            assert said == "topics.gaol.to = 2; no topic gaol is sent now, it waits for one; sent are /goal"
        else:
            with pytest.raises(ConfigError, match="topic 'gaol' is not in the registry; it has goal"):
                live.change("topics.gaol.to", 2)
        (counted,) = source.stats()["topics"].values()
        assert (counted["submitted"], counted["types"], counted["sent"]) == (5, 1, 5)
        counts = lambda: [sink.stats()["topics"]["/rx_robot_1/goal"]["delivered"] for sink in sinks]  # noqa: E731
        wait_for(lambda: counts() == [3, 3], "the counts of what was heard")
        assert source.config.topics["goal"].to == 2
        assert sorted(str(topic.options.to) for _, topic in source.subscriptions.named()) == ["2", "3", "auto"]
        assert {name for name, _ in source.subscriptions.named()} == {"/goal"}
    finally:
        top.stop()
        top.wait()
        ends: list[Any] = [one, *others, near, *far]
        for end in ends:
            end.close()


def test_what_can_change_is_what_the_blocks_say(tmp_path: Path) -> None:
    (tmp_path / "topics.csv").write_text(f"goal,{STRING}\n")
    common: dict[str, Any] = {"graph_middleware": "memory", "registry": str(tmp_path / "topics.csv")}
    both = link(robot=1, graph_domain_id=free_domains(1)[0], **common)
    source, sink = both.source, both.sink
    try:
        live = LiveSettings(source, sink)
        ours = {"packet_rate", "repeat_s", "queue_depth", "debug"}
        assert {setting.name for setting in settings_of(RobotConfig) if live.can_change(setting.name)} == ours
        assert live.can_change(TO)
        assert not live.can_change("topics.goal.codec")
        with pytest.raises(ConfigError) as error:
            live.change("packet_len", 100)
        said = str(error.value).partition("these can: ")[2]
        assert {name for name in ours if name in said} == ours
        assert "topics.TOPIC.to|qos" in said
        assert live.change("queue_depth", 7) == "queue_depth = 7"
        assert live.change("queue_depth", "7\n") == "queue_depth = 7"
        assert source.config.queue_depth == 7
        live.change("debug", True)
        assert source.config.debug and sink.config.debug
        with pytest.raises(ConfigError, match="queue_depth = -1"):
            live.change("queue_depth", -1)
    finally:
        both.close()
