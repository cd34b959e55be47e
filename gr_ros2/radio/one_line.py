"""A link described on one command line: a robot's number, a radio, and how this radio reaches the others.

Invariant: the result has the form of a link's YAML file and goes through the same loader. The command line sets nothing
that the file could not set. Settings that are left out have the defaults of the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy import PHY
from gr_ros2.radio import FRONT_ENDS, PRESETS, Preset
from gr_ros2.settings.topic_choice import words_of


@dataclass(frozen=True)
class Flag:
    """An option of the command line.

    :param settings: names of the setting that the option sets; a front end has at most one of them
    :param meaning: description for help and errors
    """

    settings: tuple[str, ...]
    meaning: str

    def setting(self, known: Mapping[str, object]) -> str | None:
        """Its setting among the ``known`` ones of a front end; None if that has none."""
        return next((name for name in self.settings if name in known), None)


FLAGS: Mapping[str, Flag] = {
    "listen": Flag(("bind", "listen"), "zmq, udp: own address, host:port; a port alone is on all interfaces"),
    "peer": Flag(("connect", "send_to"), "zmq, udp: address of another robot, host:port; may stand several times"),
    "device": Flag(
        ("args", "device"),
        "which device, in the words of its driver, without it the first found; kiss, serial: /dev/ttyUSB0 or "
        "tcp://HOST:PORT",
    ),
    "frequency": Flag(("frequency",), "Hz, to send at, and to receive at unless --frequency-rx says otherwise"),
    "frequency-rx": Flag(("frequency_rx",), "Hz, to receive at"),
}


def one_line(
    robot: int, radio: str, registry: str | None, flags: Mapping[str, Any], topics: str | None = None
) -> dict[str, Any]:
    """A link's settings, as its YAML file would have them.

    :param robot: 0..254; its topics are in the namespace ``/robot_N``
    :param radio: a name of ``gr_ros2.radio.FRONT_ENDS`` or ``PRESETS``
    :param registry: CSV path or the name of a built-in one; None finds the topics on the ROS graph
    :param flags: value of each option of ``FLAGS`` that was given
    :param topics: which topics of the registry, or without one of the ROS graph; None sends all of them
    :raises ConfigError: for an unknown radio, an option that the radio does not have, or a missing option that it needs
    :raises BackendMissingError: when software that the radio needs is not installed
    """
    preset = PRESETS.get(radio)
    front_end = preset.front_end if preset else radio
    if front_end not in FRONT_ENDS:
        raise ConfigError(f"radio: no {radio!r}; known are {', '.join([*FRONT_ENDS, *PRESETS])}")
    known = {item.name: item for item in fields(FRONT_ENDS.load(front_end).Options)}
    names = {name: setting for name, flag in FLAGS.items() if (setting := flag.setting(known)) is not None}
    for flag in flags:
        if flag not in names:
            takes = [f"--{name}" for name in names]
            raise ConfigError(f"--{flag}: radio {radio} has no such setting; it takes {', '.join(takes) or 'none'}")
    for name, setting in names.items():
        item = known[setting]
        if name not in flags and item.default is MISSING and item.default_factory is MISSING:
            raise ConfigError(f"--{name} is missing, radio {radio} needs it ({FLAGS[name].meaning})")
    chosen = {names[flag]: list(value) if isinstance(value, tuple) else value for flag, value in flags.items()}
    chosen_topics = {} if topics is None else {"topics": list(words_of(topics))}
    return {
        "name": f"robot_{robot}",
        "robot": f"/robot_{robot}",
        **({"registry": registry} if registry else {}),
        **chosen_topics,
        **({"packet_len": preset.packet_len} if preset else {}),
        **({"medium": preset.medium} if preset and preset.medium else {}),
        "phy": _phy(front_end, preset),
        "front_end": {"name": front_end, **(preset.settings if preset else {}), **chosen},
    }


def _phy(front_end: str, preset: Preset | None) -> dict[str, Any]:
    backend = FRONT_ENDS[front_end]
    phy: dict[str, Any] = {"name": (preset and preset.phy) or backend.phy}
    if PHY.load(phy["name"]).has_samples:
        phy["sample_rate"] = (preset and preset.sample_rate) or backend.sample_rate
    options = preset.phy_options if preset else backend.phy_options
    return {**phy, **({"options": dict(options)} if options else {})}
