"""Packets through the blocks of others: in batches as far as is known what comes, otherwise one by one."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from gr_ros2.phy import Phy, measure
from gr_ros2.phy.ofdm import OfdmPhy
from gr_ros2.settings.config import ChannelConfig
from gr_ros2_lab.medium import FixedPaths, RadioPath, Reception, Transmission
from gr_ros2_lab.medium.flowgraph import FlowgraphMedium

PACKETS = [bytes([number]) * 64 for number in (1, 2, 2, 3)]


def test_what_is_foreseen_passes_together_and_what_is_not_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    phy = OfdmPhy(64, 1e5, detection_threshold="stock")
    passed: list[int] = []
    modulated = measure.modulated

    def counted(phy: Phy, packets: Sequence[bytes]) -> measure.SampleRecording:
        passed.append(len(packets))
        return modulated(phy, packets)

    monkeypatch.setattr(measure, "modulated", counted)

    def heard(ahead: list[Transmission]) -> tuple[list[Transmission], list[Reception]]:
        medium = FlowgraphMedium(FixedPaths([[RadioPath(1, ChannelConfig())], []]), [phy, phy], ahead)
        sent = [medium.send(0, data, float(number), phy.airtime()) for number, data in enumerate(PACKETS)]
        receptions = list(medium.receptions(len(PACKETS)))
        assert [reception.packet.data for reception in receptions] == PACKETS
        assert [reception.packet.at for reception in receptions] == [0.0, 1.0, 2.0, 3.0]
        return sent, receptions

    sent, one_by_one = heard([])
    assert heard(sent)[1] == heard([sent[0], sent[3]])[1] == heard([sent[1]._replace(start=0.5)])[1] == one_by_one
    assert passed == [1, 1, 1, 1, 4, 2, 1, 1, 1, 1, 1, 1]
