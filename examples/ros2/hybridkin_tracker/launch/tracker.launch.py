"""Start the tracker with its parameters: ros2 launch hybridkin_tracker tracker.launch.py."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    share = Path(get_package_share_directory("hybridkin_tracker"))
    return LaunchDescription(
        [
            Node(
                package="hybridkin_tracker",
                executable="tracker",
                name="hybridkin_tracker",
                parameters=[str(share / "config" / "tracker.yaml")],
                output="screen",
            )
        ]
    )
