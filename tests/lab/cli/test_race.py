from __future__ import annotations

import pytest

from gr_ros2.cli.main import BAD_INPUT, run


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["--loss", "some"], "--loss some: write percentages with commas between, such as 0,5,20"),
        (["--load", "-50"], "race: load.0 = -0.5: must be greater than 0\n"),
        (["--load", "50", "--sample-rate", "1e5"], "load = (0.5,): sample_rate decides it; leave one of both out"),
        (["--topic", "/odom"], "bag_topic = '/odom': a simulated robot has one topic"),
        (["--peers", "nobody"], "peers = 'nobody': no such contender; known are gr-ros2, gr-ros2-v0"),
        (["--source", "here.mcap"], "source = 'here.mcap': write sim or bag:PATH"),
        (["--duration", "0"], "duration_s = 0"),
        (["--robots", "11"], "robots = 11: must be less than or equal to 10"),
    ],
)
def test_wrong_input_is_one_line_and_status_2(
    arguments: list[str], problem: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["race", *arguments]) == BAD_INPUT
    (line,) = capsys.readouterr().err.splitlines(keepends=True)
    assert line.startswith("gr-ros2: ")
    assert problem in line
