"""Play a bag to the lifter and look.

ros2 launch deep_nrsfm_ros replay_bag.launch.py bag:=my_bag keypoints:=/keypoints
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """Return player, lifter and RViz with their arguments."""
    share = FindPackageShare("deep_nrsfm_ros")
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="Folder or file of the recording."),
            DeclareLaunchArgument(
                "keypoints",
                default_value="/keypoints",
                description="Topic of the 2D keypoints in the bag; no other is played.",
            ),
            DeclareLaunchArgument(
                "rate", default_value="1.0", description="How many times as fast as recorded."
            ),
            DeclareLaunchArgument(
                "config",
                default_value=PathJoinSubstitution([share, "config", "lifter.yaml"]),
                description="Parameter file of the lifter: model, detector's layout, scale.",
            ),
            DeclareLaunchArgument(
                "rviz", default_value="true", description="Whether to open RViz: true or false."
            ),
            DeclareLaunchArgument(
                "camera_frame",
                default_value="camera",
                description="frame_id of the keypoints: the camera's optical frame.",
            ),
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
            ExecuteProcess(
                cmd=[
                    *("ros2", "bag", "play", LaunchConfiguration("bag")),
                    *("--rate", LaunchConfiguration("rate")),
                    *("--topics", LaunchConfiguration("keypoints")),
                ],
                output="screen",
            ),
        ]
    )
