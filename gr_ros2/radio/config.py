"""The configuration of `gr-ros2 link`: one robot's end of a link as one YAML file.

Invariant: the settings of the front end are under `front_end`. Its sample rate is that of the PHY.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from gr_ros2.core.errors import ConfigError
from gr_ros2.middleware import MIDDLEWARE
from gr_ros2.phy import PHY, Phy, configured
from gr_ros2.radio import FRONT_ENDS
from gr_ros2.radio.permission import check_band
from gr_ros2.settings.airtime import Airtime, AirtimeConfig
from gr_ros2.settings.config import (
    BOUND_TO_NONE,
    STRICT,
    AirConfig,
    ChannelConfig,
    ClockConfig,
    DiagnosticsConfig,
    Medium,
    PacketLen,
    PhyConfig,
    Text,
    build,
    check_medium,
)
from gr_ros2.settings.effect import ActsWhere
from gr_ros2.settings.fields import AUTO, Auto
from gr_ros2.settings.files import read_settings
from gr_ros2.settings.robot import ONE_RADIO, RobotConfig
from gr_ros2.wire import BOUND, FORMATS

_MOST_RADIOS = 4
"""Radios of one robot: more than anybody has carried."""


@dataclass(frozen=True, kw_only=True, config=STRICT)
class RadioConfig:
    """One of several radios of a robot."""

    name: str = ""
    """what status and log call it; '' = the name of its front end"""
    phy: PhyConfig | Auto = AUTO
    """its physical layer; auto = the link's"""
    front_end: dict[str, Any]
    """``name`` of its front end, and that front end's settings"""
    packet_len: Annotated[PacketLen | Auto, Field(title="Packet length of what goes over it alone (bytes)")] = AUTO
    """bytes of the longest packet of topics whose ``via`` names it, the same at all robots; auto = the link's"""
    airtime: Airtime | Auto = AUTO
    """how much it may send, with an account of its own: settings, or the name of a band; auto = as the link says"""
    medium: Medium | Auto = AUTO
    """when it sends; with slots or aloha it carries only what names it in ``via``; auto = as the link says"""


class OwnRadio(NamedTuple):
    """A radio with all that it has of the link.

    :param called: what status and log call it
    :param packet_len: bytes of the longest packet of topics that go over it alone
    """

    called: str
    phy: PhyConfig
    front_end: Mapping[str, Any]
    airtime: AirtimeConfig
    packet_len: int
    medium: Medium

    @property
    def shares(self) -> bool:
        """Whether other robots send on its channel."""
        return self.medium != "exclusive"

    @property
    def front_end_name(self) -> str:
        """Name of the front end in ``FRONT_ENDS``."""
        return str(self.front_end["name"])

    @property
    def front_end_options(self) -> dict[str, Any]:
        """The settings of the front end."""
        return {key: value for key, value in self.front_end.items() if key != "name"}

    def made_phy(self, packet_len: int) -> Phy:
        """Its PHY, for packets of so many bytes of the link, and for its own.

        :raises ConfigError: for a wrong setting
        """
        rate = self.phy.sample_rate
        longest = self.packet_len if self.shares else max(packet_len, self.packet_len)
        phy = configured(self.phy, longest, 0.0 if rate == AUTO else rate)
        if packet_len != self.packet_len and not (self.shares or phy.any_length):
            raise ConfigError(
                f"radio {self.called}: packet_len = {self.packet_len}, where that of the link is {packet_len}, and phy "
                f"{self.phy.name} sends packets of one length; leave it out, or set lengths: any in the phy's options"
            )
        return phy

    def check(self, where: str) -> None:
        """:raises ValueError: for what no radio can be"""
        for key, name, table in (
            (f"{where}phy.name", self.phy.name, PHY),
            (f"{where}front_end.name", self.front_end_name, FRONT_ENDS),
        ):
            if name not in table:
                raise ValueError(f"{key} = {name!r}: no such {table.family}; known are {', '.join(table)}")
        rate = self.phy.sample_rate
        if rate == AUTO and PHY.load(self.phy.name).has_samples:
            raise ValueError(
                f"{where}phy.sample_rate = auto: a link needs one; set it to what the radio can do, samples/s"
            )
        check_medium(self.medium, self.phy, self.airtime, where)
        check_band(self.airtime, self.front_end_options, 0.0 if rate == AUTO else rate)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class LinkConfig(AirConfig, RobotConfig):
    """One robot's end of a link: its ROS graph -> PHY -> front end, and back the same way."""

    name: Text = "link"
    """what errors and the status line call it; the file's name unless it is set"""
    front_end: dict[str, Any] = Field(default_factory=lambda: {"name": "sim"})
    """``name``, a name of ``gr_ros2.radio.FRONT_ENDS``, and that front end's settings (docs/how-to/radios.md)"""
    radios: tuple[RadioConfig, ...] = ()
    """several radios in place of ``front_end`` (docs/how-to/two-radios.md)"""
    transmit: bool | Auto = AUTO
    """whether it sends: a radio needs true, auto = yes without a radio"""
    open: Annotated[bool, Field(title="Without a key")] = False
    """a radio may send without a key"""
    channel: ChannelConfig = Field(default_factory=ChannelConfig)
    """impairments of what is received, for front ends without a radio"""
    record: Annotated[str, Field(title="Recording of what is received")] = ""
    """SigMF recording to write of all samples received, '' = none"""
    clock: ClockConfig = Field(default_factory=ClockConfig)
    """how the clocks of other robots are watched, and given to chrony (docs/how-to/ros2.md)"""
    diagnostics: DiagnosticsConfig = Field(default_factory=DiagnosticsConfig)
    """what the link says on ``/diagnostics`` (docs/how-to/ros2.md)"""

    conditions: ClassVar[Any] = (
        ActsWhere(
            ("topics.*.via", "offer.*.via"),
            lambda link: bool(link.radios),
            f"{ONE_RADIO}; set radios, or leave it out",
        ),
        ActsWhere(("front_end",), lambda link: not link.radios, "with radios, each has its own; leave it out"),
        ActsWhere(
            ("medium",),
            lambda link: not link.radios or any(radio.medium == AUTO for radio in link.radios),
            "each radio has its own; leave it out",
        ),
        ActsWhere(
            ("publish.stamps",),
            lambda link: not link.graph.use_sim_time,
            "all stamps follow one /clock; leave graph.use_sim_time or publish.stamps out",
        ),
        ActsWhere(("record",), lambda link: not link.radios, "several radios have no signal in common; leave it out"),
    )

    @model_validator(mode="after")
    def _known(self) -> LinkConfig:
        for where, front_end in [
            ("", self.front_end),
            *((f"radios.{n}.", r.front_end) for n, r in enumerate(self.radios)),
        ]:
            if "name" not in front_end:
                raise ValueError(f"{where}front_end.name is missing; known are {', '.join(FRONT_ENDS)}")
        if self.radios:
            self._several()
        if self.graph.middleware not in MIDDLEWARE:
            raise ValueError(
                f"graph.middleware = {self.graph.middleware!r}: no such {MIDDLEWARE.family}; known are "
                f"{', '.join(MIDDLEWARE)}"
            )
        for number, own in enumerate(self.own_radios):
            own.check(f"radios.{number}." if self.radios else "")
        if self.airtime.rule is not None and self.packet_rate == 0:
            raise ValueError("packet_rate = 0: sends whatever airtime allows; set auto, or leave airtime out")
        self.airtime.check_seal(encrypts=bool(self.key) and self.seal == "encrypt")
        if self.packet_len < (least := FORMATS[1].min_packet_len):
            raise ValueError(f"packet_len = {self.packet_len}: a link needs at least {least}")
        self._check_bound(least)
        return self

    def _several(self) -> None:
        """:raises ValueError: for what several radios cannot have"""
        names = [own.called for own in self.own_radios]
        if len(names) < 2 or len(names) > _MOST_RADIOS:
            raise ValueError(f"radios: {len(names)} of 2 to {_MOST_RADIOS}; one alone is front_end")
        if len(set(names)) < len(names):
            raise ValueError(f"radios: two are called {max(names, key=names.count)!r}; give each a name of its own")
        if all(own.shares for own in self.own_radios):
            raise ValueError(
                f"radios: all have medium {self.own_radios[0].medium}, so none carries what names no radio in via; set "
                "medium: exclusive at one, or run a link for each"
            )
        if words := sorted(BOUND_TO_NONE.intersection(names)):
            raise ValueError(f"radios: one is called {words[0]!r}, which means another thing in via; call it otherwise")

    def _check_bound(self, least: int) -> None:
        """:raises ValueError: for topics that cannot go over one radio alone"""
        names, bound = [own.called for own in self.own_radios], set[str]()
        for part, chosen in (("topics", self.topics), ("offer", self.offer)):
            for word, options in chosen.items():
                if (via := options.via) in BOUND_TO_NONE:
                    continue
                bound.add(via)
                if via not in names:
                    raise ValueError(f"{part}.{word}.via = {via!r}: best, all, or one of {', '.join(names)}")
        for own in self.own_radios:
            needed = least if own.shares else least + len(BOUND)
            if own.packet_len < needed and (own.shares or own.called in bound):
                raise ValueError(
                    f"packet_len = {own.packet_len} of radio {own.called}: topics bound to it need {needed}"
                )

    @property
    def has_slots(self) -> bool:
        return any(own.medium == "slots" for own in self.own_radios)

    @property
    def remark(self) -> str:
        """A remark for the person who starts the link; often empty."""
        if self.key:
            return ""
        return "no key, so anybody can read, forge and replay its packets (gr-ros2 key new FILE)"

    @property
    def own_radios(self) -> tuple[OwnRadio, ...]:
        """Its radios: those of ``radios``, or the one of ``front_end``."""
        radios = self.radios or (RadioConfig(front_end=self.front_end),)
        return tuple(
            OwnRadio(
                radio.name or str(radio.front_end["name"]),
                self.phy if radio.phy == AUTO else radio.phy,
                radio.front_end,
                self.airtime if radio.airtime == AUTO else radio.airtime,
                self.packet_len if radio.packet_len == AUTO else radio.packet_len,
                self.medium if radio.medium == AUTO else radio.medium,
            )
            for radio in radios
        )

    @property
    def front_end_name(self) -> str:
        """Name of the front end in ``FRONT_ENDS``; of several radios, that of the first."""
        return self.own_radios[0].front_end_name

    @property
    def front_end_options(self) -> dict[str, Any]:
        """The settings of that front end."""
        return self.own_radios[0].front_end_options


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
