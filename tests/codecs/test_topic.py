"""Which codec a topic has, and what happens to messages that none takes."""

from __future__ import annotations

import sys

import pytest

from gr_ros2.codecs import CODECS, CodedTopic
from gr_ros2.codecs.messages import CLOUD, GRID, IMAGE
from gr_ros2.core.errors import ConfigError
from tests.codecs import scenes


def test_a_type_without_a_codec_passes_exactly() -> None:
    topic = CodedTopic("std_msgs/msg/String")
    message = scenes.write("std_msgs/msg/String", data="here")
    assert list(topic.codecs) == [0]
    assert topic.decoder().decode(topic.encoder().encode(message).data) == message


def test_a_codec_that_is_off_passes_exactly() -> None:
    topic = CodedTopic(CLOUD, {"cloud": "off"})
    message = scenes.cloud(scenes.street(0, 4, 20))
    frame = topic.encoder().encode(message).data
    assert frame[0] == CODECS["exact"].number
    assert topic.decoder().decode(frame) == message


def test_a_message_that_its_codec_does_not_take_passes_exactly_and_the_reason_is_said() -> None:
    topic = CodedTopic(CLOUD, {"cloud": {"voxel": 0.1}})
    message = scenes.cloud(scenes.street(0, 4, 20), layout=(("range", 0, 7),))
    coded = topic.encoder().encode(message)
    assert topic.decoder().decode(coded.data) == message
    assert coded.said == "cloud: no fields x, y and z of floating-point numbers"


def test_without_its_package_a_topic_passes_exactly_and_the_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    topic = CodedTopic(IMAGE)
    message = scenes.image(scenes.view(0, 32, 16), "rgb8")
    coded = topic.encoder().encode(message)
    assert topic.decoder().decode(coded.data) == message
    assert "needs PyAV (pip install 'gr-ros2[video]')" in coded.said


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"clouds": {}}, "no codec 'clouds'; known are exact, "),
        ({"cloud": {"edge": 1}}, "cloud: no option 'edge'; known are voxel, range, keep"),
        ({"cloud": "on"}, "cloud: 'on' is neither its options nor 'off'"),
        ({"cloud": {"voxel": -1.0}}, "cloud: voxel is -1.0"),
        ({"cloud": {"range": 0}}, "cloud: range is 0"),
        ({"cloud": {"keep": "ring"}}, "cloud: keep is 'ring'"),
    ],
)
def test_a_wrong_option_is_named(options: dict[str, object], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        CodedTopic(CLOUD, options)  # type: ignore[arg-type]
    assert CodedTopic(GRID).codecs
