# SPDX-License-Identifier: Apache-2.0
"""Start the lifter: ros2 launch deep_nrsfm_ros lifter.launch.py keypoints:=/detector/keypoints."""

import os

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return the launch description; `ros2 launch --show-args` prints its arguments."""
    share = FindPackageShare("deep_nrsfm_ros")

    def text(name: str) -> ParameterValue:
        return ParameterValue(LaunchConfiguration(name), value_type=str)

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
                "keypoint_layout",
                default_value="auto",
                description="Order in which the detector gives its keypoints: coco17, body25, "
                "mediapipe33, ...; auto = as the messages imply.",
            ),
            DeclareLaunchArgument(
                "input_type",
                default_value="auto",
                description="Type of the detector's messages, or the path of a field mapping; "
                "auto = that of the first publisher.",
            ),
            DeclareLaunchArgument(
                "model",
                default_value="human",
                description="Model to lift with: a name or a path.",
            ),
            DeclareLaunchArgument(
                "camera_info",
                default_value="",
                description="Topic of the camera's CameraInfo, for points at their place; "
                "empty = each object centred.",
            ),
            DeclareLaunchArgument(
                "reference_length",
                default_value="0.0",
                description="Length of the reference pair in the output, such as 0.5 m from neck "
                "to mid-hip of an adult; 0 = as the model's layout says.",
            ),
            DeclareLaunchArgument(
                "managed",
                default_value="false",
                description="Whether the lifter is a managed node, which waits for the transitions "
                "configure and activate.",
            ),
            DeclareLaunchArgument(
                "config",
                default_value=PathJoinSubstitution([share, "config", "lifter.yaml"]),
                description="Parameter file of the lifter; what it sets wins over the arguments.",
            ),
            Node(
                package="deep_nrsfm_ros",
                executable="lifter",
                name="lifter",
                namespace=LaunchConfiguration("namespace"),
                parameters=[
                    {
                        "keypoint_layout": text("keypoint_layout"),
                        "input_type": text("input_type"),
                        "model": text("model"),
                        "camera_info": text("camera_info"),
                        "reference_length": ParameterValue(
                            LaunchConfiguration("reference_length"), value_type=float
                        ),
                        "managed": ParameterValue(LaunchConfiguration("managed"), value_type=bool),
                    },
                    LaunchConfiguration("config"),
                ],
                remappings=[("keypoints", LaunchConfiguration("keypoints"))],
                output="screen",
                # The lifter ends with this launch, even if the launch is killed.
                additional_env={"DEEP_NRSFM_LAUNCH_PID": str(os.getpid())},
            ),
        ]
    )
