#!/bin/sh
exec /usr/lib/gr-ros2/bin/python3 /usr/lib/gr-ros2/bin/gr-ros2.py "$@"
