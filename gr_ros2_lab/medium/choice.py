"""Which medium carries a run."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from gr_ros2.core.errors import ConfigError
from gr_ros2.phy import Phy
from gr_ros2_lab.medium.base import Medium, Surroundings, Transmission
from gr_ros2_lab.medium.flowgraph import FlowgraphMedium
from gr_ros2_lab.medium.packets import PacketMedium
from gr_ros2_lab.medium.samples import SampleMedium


def make_medium(
    around: Surroundings,
    phys: Sequence[Phy],
    *,
    samples: bool,
    shared: bool = False,
    seed: int = 0,
    ahead: Iterable[Transmission] = (),
) -> Medium:
    """The medium for these robots.

    :param samples: bursts cross as samples, where the PHYs have any; otherwise packets are lost as measured
    :param ahead: see :class:`FlowgraphMedium`
    :raises ConfigError: for PHYs of stock or foreign blocks that share one channel
    """
    if not samples or not any(phy.has_samples for phy in phys):
        return PacketMedium(around, phys, shared=shared, seed=seed)
    if all(phy.burst_modem is not None for phy in phys):
        return SampleMedium(around, phys, shared=shared, seed=seed)
    if around.moves:
        raise ConfigError(
            f"{around.moves}: phy {phys[0].name} runs on {phys[0].runs_on()}, whose channel stands still; "
            "set time to packets, or take a receiver of this package"
        )
    if shared:
        raise ConfigError(
            f"phy {phys[0].name} runs on {phys[0].runs_on()}, whose bursts cannot be added up on one channel; "
            "set time to packets, or take a receiver of this package"
        )
    return FlowgraphMedium(around, phys, ahead)
