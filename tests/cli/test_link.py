"""The one line that says how a live link is doing."""

from __future__ import annotations

from typing import Any

from gr_ros2.cli.link import status_line


def stats(
    snr_db: float | None, missing: int = 0, damaged: int = 0, unpublished: int = 0, lost: int = 0
) -> dict[str, Any]:
    return {
        "uptime_s": 12.4,
        "source": {
            "topics": {"/odom": {"submitted": 7, "lost_on_graph": lost}, "/scan": {"submitted": 1, "lost_on_graph": 0}}
        },
        "sink": {
            "topics": {"/rx_robot_2/odom": {"delivered": 5}},
            "packet_loss_est": missing,
            "publish_failed": unpublished,
        },
        "packets": {"out": 90, "in": 60, "refused": 0, "damaged": damaged},
        "phy": {"snr_db": snr_db},
        "front_end": {"name": "uhd", "bursts_out": 90, "overflows": 0},
    }


def test_what_passes_is_told_always_and_the_rest_where_there_is_any() -> None:
    quiet = "12 s; sent 8 messages in 90 packets; received 5 messages in 60 packets"
    assert status_line(stats(None)) == quiet
    assert status_line(stats(17.26, missing=3, damaged=2)) == (quiet + "; about 3 packets lost; SNR 17.3 dB; 2 damaged")
    assert status_line(stats(None, lost=6, unpublished=4)) == (
        quiet + "; 6 messages lost on the ROS graph before they were sent; 4 messages not published"
    )
