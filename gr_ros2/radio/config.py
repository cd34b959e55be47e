"""The configuration of `gr-ros2 link`: one robot's end of a link as one YAML file.

Invariant: the settings on which both ends of a link must agree (`registry`, `packet_len`, `phy`) are at the top level.
The settings of the front end are under `front_end`. Its sample rate is that of the PHY.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import MIDDLEWARE
from gr_ros2.phy import PHY
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.permission import check_band
from gr_ros2.settings.config import AnyLink, DiagnosticsConfig, Text, build
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.files import SHARED_KEYS, read_settings, with_shared
from gr_ros2.settings.registry import Registry, check_outputs


@dataclass(frozen=True, kw_only=True, config=ConfigDict(extra="forbid", str_strip_whitespace=True))
class LinkConfig(AnyLink):
    """One robot's end: its ROS graph -> RosSource -> PHY -> front end, and back the same way.

    :param name: what errors and the status line call it
    :param registry: CSV path, relative to the YAML file, or the name of a built-in one: the topics that are sent; with
        version 0 the same at every robot, with version 1 each announces its own; '' sends what ``ros_source.topics``
        finds on the ROS graph
    :param ros_source: the sending block; its robot_id must be another at every robot
    :param phy: which physical layer, at which sample rate; the same at every robot. ``headroom`` is not used
    :param front_end: ``name``, a name of ``gr_ros2.radio.FRONT_ENDS``, and that front end's settings
        (docs/how-to/radios.md)
    :param transmit: whether it sends: auto = yes, where no radio is connected; a radio needs true, the word of the
        person who answers for it; false = it only receives
    :param open: a radio may send without a key, so that anybody can read and forge what crosses
    :param channel: impairments of what is received, for front ends without a radio
    :param record: SigMF recording to write of all samples received, '' = none
    :param diagnostics: what the link says of itself on ``/diagnostics``, and its limits (docs/how-to/ros2.md)
    """

    registry: str = ""
    name: Text = "link"
    front_end: dict[str, Any] = Field(default_factory=lambda: {"name": "sim"})
    transmit: bool | Auto = AUTO
    open: Annotated[bool, Field(title="Without a key")] = False
    record: Annotated[str, Field(title="Recording of what is received")] = ""
    diagnostics: DiagnosticsConfig = Field(default_factory=DiagnosticsConfig)

    @model_validator(mode="after")
    def _known(self) -> LinkConfig:
        if not self.registry and not self.version:
            raise ValueError("registry is missing, and version 0 needs the same one at every robot")
        if "name" not in self.front_end:
            raise ValueError(f"front_end.name is missing; known are {', '.join(FRONT_ENDS)}")
        for key, name, table in (
            ("ros_source.middleware", self.ros_source.middleware, MIDDLEWARE),
            ("ros_sink.middleware", self.ros_sink.middleware, MIDDLEWARE),
            ("phy.name", self.phy.name, PHY),
            ("front_end.name", self.front_end_name, FRONT_ENDS),
        ):
            if name not in table:
                raise ValueError(f"{key} = {name!r}: no such {table.family}; known are {', '.join(table)}")
        if self.phy.sample_rate == AUTO and PHY.load(self.phy.name).has_samples:
            raise ValueError("phy.sample_rate = auto: a link needs one; set it to what the radio can do, samples/s")
        self.ros_source.src_id()
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

    def load_registry(self) -> Registry:
        """Load the registry.

        :raises RegistryError: for a wrong file; the message names file, line and problem
        :raises ConfigError: when the sink could not publish its topics, see
            :func:`gr_ros2.settings.registry.check_outputs`
        """
        if not self.registry:
            return Registry.empty()
        registry = Registry.from_csv(self.registry)
        check_outputs(registry, self.ros_sink)
        return registry


def link_from(values: Mapping[str, Any], where: str = "") -> LinkConfig:
    """Make a link's configuration from a mapping.

    :param where: what to call the mapping in errors, for instance its file name
    :raises ConfigError: for an unknown key, a value out of range, or blocks that disagree; the message names it
    """
    values = dict(values)
    shared = {key: values[key] for key in SHARED_KEYS if key in values}
    values |= with_shared(values, shared, f"{where}: " if where else "")
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
