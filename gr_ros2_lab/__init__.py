"""The laboratory of gr-ros2: simulated robots and channels, runs, what they leave behind, and studies of many runs.

It imports `gr_ros2`, which is what a robot runs, and is never imported by it.
"""
