# SPDX-License-Identifier: Apache-2.0
"""Start detector, lifter and RViz; the detector is a command, or is already running.

ros2 launch deep_nrsfm_ros live.launch.py keypoints:=/keypoints config:=my_lifter.yaml \
    detector:="ros2 run deep_nrsfm_ros mediapipe_detector --ros-args -p source:=0"
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, NotEqualsSubstitution, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return the launch description of detector, lifter and RViz."""
    share = FindPackageShare("deep_nrsfm_ros")
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "detector",
                default_value="",
                description="Command that starts the detector; empty = it is already running.",
            ),
            DeclareLaunchArgument(
                "keypoints",
                default_value="/keypoints",
                description="Topic of the detector's 2D keypoints.",
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
            DeclareLaunchArgument(
                "fixed_frame",
                default_value="world",
                description="Frame in which RViz shows the points.",
            ),
            DeclareLaunchArgument(
                "level_camera",
                default_value="true",
                description="Whether a level camera is published in the fixed frame, so people "
                "stand upright: true, or false if TF already has the camera.",
            ),
            ExecuteProcess(
                cmd=[LaunchConfiguration("detector")],
                shell=True,
                output="screen",
                condition=IfCondition(NotEqualsSubstitution(LaunchConfiguration("detector"), "")),
            ),
            Node(
                package="tf2_ros",
                executable="static_transform_publisher",
                arguments=[
                    *("--frame-id", LaunchConfiguration("fixed_frame")),
                    *("--child-frame-id", LaunchConfiguration("camera_frame")),
                    *("--roll", "-1.5707963", "--yaw", "-1.5707963"),  # x right, y down, z forward
                ],
                condition=IfCondition(LaunchConfiguration("level_camera")),
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=[
                    *("-d", PathJoinSubstitution([share, "config", "lifter.rviz"])),
                    *("-f", LaunchConfiguration("fixed_frame")),
                ],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
            # Last: if a package above is missing, no lifter is left running.
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(
                    PathJoinSubstitution([share, "launch", "lifter.launch.py"])
                ),
                launch_arguments={
                    "keypoints": LaunchConfiguration("keypoints"),
                    "config": LaunchConfiguration("config"),
                }.items(),
            ),
        ]
    )
