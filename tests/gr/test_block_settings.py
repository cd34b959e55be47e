"""The settings that both blocks share."""

from __future__ import annotations

import pytest

from gr_ros2.core.errors import ConfigError
from gr_ros2.gr.block_settings import read_registry, settings
from gr_ros2.middleware.memory import MemoryMiddleware
from gr_ros2.settings.config import SinkConfig, SourceConfig, replaced


def test_settings_name_what_is_wrong() -> None:
    with pytest.raises(ConfigError, match="packet_len = 13"):
        settings(SourceConfig, {"packet_len": 13}, "x.csv", None)
    with pytest.raises(ConfigError, match="unknown key colour"):
        settings(SinkConfig, {"colour": 1}, "x.csv", None)
    with MemoryMiddleware(domain_id=54) as opened:
        assert settings(SinkConfig, {}, "x.csv", opened).middleware == "memory"
    assert replaced(SinkConfig(), debug=True).debug
    with pytest.raises(ConfigError, match="registry is missing"):
        read_registry("")
