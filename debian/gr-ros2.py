"""The command gr-ros2, by the environment's Python. `python3 -m` would import from the folder in which it is typed."""

from gr_ros2.cli.__main__ import main

main()
