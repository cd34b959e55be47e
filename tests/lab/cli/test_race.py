from __future__ import annotations

import pytest

from gr_ros2.cli.main import BAD_INPUT, run


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["--loss", "some"], "--loss some: write percentages with commas between, such as 0,5,20"),
        (["--load", "-50"], "load.0 = -0.5"),
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
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("gr-ros2: ")
    assert problem in line
