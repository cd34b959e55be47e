"""Our own drive is what `tools/record-drive` writes, and small enough to be part of every clone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from rosbags.typesys import Stores, get_typestore

from gr_ros2.middleware.bag_files import bag_topics, read_bag
from tests.recordings import SIMULATED, Drive, every_drive

ROOT = Path(__file__).resolve().parent.parent


def test_ours_is_what_the_command_writes(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "tools" / "record-drive"), str(tmp_path / "again")]
    subprocess.run(command, check=True, capture_output=True, env={"PYTHONPATH": str(ROOT)})
    # The last bits of its numbers are the processor's and numpy's; everything else is ours.
    ours, again = (
        [(message.topic, message.type_name, message.stamp_ns, len(message.payload)) for message in read_bag(path)]
        for path in (SIMULATED.path, tmp_path / "again")
    )
    assert ours == again, "the simulator has changed: run tools/record-drive"
    assert sum(path.stat().st_size for path in SIMULATED.path.iterdir()) < 160_000


@every_drive
def test_a_drive_has_what_is_said_of_it(drive: Drive) -> None:
    topics = {info.topic: info.type_name for info in bag_topics(drive.path)}
    assert topics == dict(zip(drive.names, drive.topics.values(), strict=True))
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, kind in zip(drive.names, drive.topics.values(), strict=True):
        stamps = []
        for message in read_bag(drive.path, [name]):
            assert message.type_name == kind
            header = store.deserialize_cdr(message.payload, kind).header  # type: ignore[attr-defined]
            assert header.stamp.sec * 10**9 + header.stamp.nanosec <= message.stamp_ns
            stamps.append(message.stamp_ns)
        assert stamps == sorted(stamps)
        assert len(stamps) >= 2 * (stamps[-1] - stamps[0]) * 1e-9
