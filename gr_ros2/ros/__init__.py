"""A link as a ROS 2 node, for `ros2 run` and `ros2 launch`."""
