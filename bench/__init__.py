"""What gr-ros2 promises in numbers, measured: `python -m bench [NAME …]`."""
