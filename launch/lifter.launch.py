"""Start the lifter: ros2 launch deep_nrsfm_ros lifter.launch.py keypoints:=/detector/keypoints."""

import os

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return the launch description; `ros2 launch --show-args` prints its arguments."""
    share = FindPackageShare("deep_nrsfm_ros")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "keypoints",
                default_value="keypoints",
                description="Topic of the detector's 2D keypoints, in pixels.",
            ),
            DeclareLaunchArgument(
                "namespace",
                default_value="",
                description="Namespace of the node, such as the name of its camera; empty = none.",
            ),
            DeclareLaunchArgument(
                "config",
                default_value=PathJoinSubstitution([share, "config", "lifter.yaml"]),
                description="Parameter file of the lifter: model, detector's layout, output unit.",
            ),
            Node(
                package="deep_nrsfm_ros",
                executable="lifter",
                name="lifter",
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("config")],
                remappings=[("keypoints", LaunchConfiguration("keypoints"))],
                output="screen",
                # The lifter ends with this launch, even if the launch is killed.
                additional_env={"DEEP_NRSFM_LAUNCH_PID": str(os.getpid())},
            ),
        ]
    )
