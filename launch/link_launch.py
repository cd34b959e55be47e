"""Start one robot's end of a link: ros2 launch gr_ros2 link_launch.py config:=my_link.yaml [namespace:=robot_1]."""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription(
        [
            DeclareLaunchArgument("config", description="YAML file of the link, as for `gr-ros2 link`"),
            DeclareLaunchArgument("namespace", default_value="", description="namespace of the node"),
            DeclareLaunchArgument("name", default_value="gr_ros2_link", description="name of the node"),
            Node(
                package="gr_ros2",
                executable="link",
                name=LaunchConfiguration("name"),
                namespace=LaunchConfiguration("namespace"),
                parameters=[{"config": ParameterValue(LaunchConfiguration("config"), value_type=str)}],
                output="screen",
            ),
        ]
    )
