"""The configuration of `gr-ros2 link`: one robot's end of a link as one YAML file.

Invariant: the settings of the front end are under `front_end`. Its sample rate is that of the PHY.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import MIDDLEWARE
from gr_ros2.phy import PHY
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.permission import check_band
from gr_ros2.settings.config import STRICT, AirConfig, ChannelConfig, DiagnosticsConfig, Text, build
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.files import read_settings
from gr_ros2.settings.robot import RobotConfig
from gr_ros2.wire import FORMATS


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LinkConfig(AirConfig, RobotConfig):
    """One robot's end of a link: its ROS graph -> PHY -> front end, and back the same way."""

    name: Text = "link"
    """what errors and the status line call it; the file's name unless it is set"""
    front_end: dict[str, Any] = Field(default_factory=lambda: {"name": "sim"})
    """``name``, a name of ``gr_ros2.radio.FRONT_ENDS``, and that front end's settings (docs/how-to/radios.md)"""
    transmit: bool | Auto = AUTO
    """whether it sends: a radio needs true, auto = yes without a radio"""
    open: Annotated[bool, Field(title="Without a key")] = False
    """a radio may send without a key"""
    channel: ChannelConfig = Field(default_factory=ChannelConfig)
    """impairments of what is received, for front ends without a radio"""
    record: Annotated[str, Field(title="Recording of what is received")] = ""
    """SigMF recording to write of all samples received, '' = none"""
    diagnostics: DiagnosticsConfig = Field(default_factory=DiagnosticsConfig)
    """what the link says on ``/diagnostics`` (docs/how-to/ros2.md)"""

    @model_validator(mode="after")
    def _known(self) -> LinkConfig:
        if "name" not in self.front_end:
            raise ValueError(f"front_end.name is missing; known are {', '.join(FRONT_ENDS)}")
        for key, name, table in (
            ("graph.middleware", self.graph.middleware, MIDDLEWARE),
            ("phy.name", self.phy.name, PHY),
            ("front_end.name", self.front_end_name, FRONT_ENDS),
        ):
            if name not in table:
                raise ValueError(f"{key} = {name!r}: no such {table.family}; known are {', '.join(table)}")
        if self.phy.sample_rate == AUTO and PHY.load(self.phy.name).has_samples:
            raise ValueError("phy.sample_rate = auto: a link needs one; set it to what the radio can do, samples/s")
        if self.airtime.rule is not None and self.packet_rate == 0:
            raise ValueError("packet_rate = 0: sends whatever airtime allows; set auto, or leave airtime out")
        self.airtime.check_seal(encrypts=bool(self.key) and self.seal == "encrypt")
        if self.packet_len < (least := FORMATS[1].min_packet_len):
            raise ValueError(f"packet_len = {self.packet_len}: a link needs at least {least}")
        check_band(self.airtime, self.front_end, 0.0 if self.phy.sample_rate == AUTO else self.phy.sample_rate)
        return self

    @property
    def front_end_name(self) -> str:
        """Name of the front end in ``FRONT_ENDS``."""
        return str(self.front_end["name"])

    @property
    def front_end_options(self) -> dict[str, Any]:
        """The settings of the front end."""
        return {key: value for key, value in self.front_end.items() if key != "name"}


def link_from(values: Mapping[str, Any], where: str = "") -> LinkConfig:
    """Make a link's configuration from a mapping.

    :param where: what to call the mapping in errors, for instance its file name
    :raises ConfigError: for an unknown key or a value out of range; the message names it
    """
    return build(LinkConfig, values, where)


def load_link(path: str | Path, overrides: Sequence[str] = ()) -> LinkConfig:
    """Read the YAML file of a link.

    :param overrides: `key=value` with dotted keys and YAML values (`front_end.gain_tx=30`), in this order
    :raises ConfigError: when there is no such file, or a setting is wrong
    """
    path = Path(path)
    if not path.is_file():
        raise ConfigError(f"link {str(path)!r}: no such file; examples lie in {EXAMPLES_DIR}")
    return link_from(read_settings(path, overrides), str(path))


EXAMPLES_DIR = Path(__file__).resolve().parent.parent / "examples"
"""Folder with an example configuration for each front end, ``link-*.yaml``."""
