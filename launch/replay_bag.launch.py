# SPDX-License-Identifier: Apache-2.0
"""Play a bag to the lifter and show the result in RViz.

ros2 launch deep_nrsfm_ros replay_bag.launch.py bag:=my_bag keypoints:=/keypoints
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return the launch description of bag player, lifter and RViz."""
    share = FindPackageShare("deep_nrsfm_ros")
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="Bag to play: a folder or a file."),
            DeclareLaunchArgument(
                "keypoints",
                default_value="/keypoints",
                description="Topic of the 2D keypoints in the bag; only this topic is played.",
            ),
            DeclareLaunchArgument(
                "rate",
                default_value="1.0",
                description="Playback rate; 1.0 = as recorded, 2.0 = twice as fast.",
            ),
            DeclareLaunchArgument(
                "config",
                default_value=PathJoinSubstitution([share, "config", "lifter.yaml"]),
                description="Parameter file of the lifter: model, detector's layout, output unit.",
            ),
            DeclareLaunchArgument(
                "rviz", default_value="true", description="Whether RViz is started: true or false."
            ),
            DeclareLaunchArgument(
                "camera_frame",
                default_value="camera",
                description="Optical frame of the camera, as in the keypoints' header.",
            ),
            ExecuteProcess(
                cmd=[
                    *("ros2", "bag", "play", LaunchConfiguration("bag")),
                    *("--rate", LaunchConfiguration("rate")),
                    *("--topics", LaunchConfiguration("keypoints")),
                ],
                output="screen",
            ),
            # Last: if a package above is missing, no lifter is left running.
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(
                    PathJoinSubstitution([share, "launch", "live.launch.py"])
                ),
                launch_arguments={
                    "keypoints": LaunchConfiguration("keypoints"),
                    "config": LaunchConfiguration("config"),
                    "rviz": LaunchConfiguration("rviz"),
                    "camera_frame": LaunchConfiguration("camera_frame"),
                }.items(),
            ),
        ]
    )
