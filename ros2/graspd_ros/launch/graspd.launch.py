"""Starts the node, and RViz with `rviz:=true`.

    ros2 launch graspd_ros graspd.launch.py image:=/camera/camera/depth/image_rect_raw \\
        camera_info:=/camera/camera/depth/camera_info rviz:=true
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

SHARE = FindPackageShare("graspd_ros")
ARGUMENTS = [
    ("image", "/camera/camera/depth/image_rect_raw", "Topic of the depth image"),
    ("camera_info", "/camera/camera/depth/camera_info", "Topic of its CameraInfo"),
    ("points", "/camera/camera/depth/color/points", "Topic of the point cloud, with the parameter input: points"),
    ("labels", "/labels", "Topic of the label image, with the parameter labels: true"),
    ("address", "127.0.0.1:50051", "Address of graspd"),
    ("frame_id", "", "Frame in which grasps are reported; empty: that of the image"),
    ("parameters", PathJoinSubstitution([SHARE, "config", "graspd.yaml"]), "File with the other parameters of the node"),
    ("rviz", "false", "Also start RViz"),
    ("fixed_frame", "camera_depth_optical_frame", "Fixed frame of RViz"),
]


def text(name: str) -> ParameterValue:
    return ParameterValue(LaunchConfiguration(name), value_type=str)


def generate_launch_description() -> LaunchDescription:
    node = Node(
        package="graspd_ros",
        executable="graspd_node",
        name="graspd",
        output="screen",
        # The file is last: it overrides the arguments.
        parameters=[{"address": text("address"), "frame_id": text("frame_id")}, LaunchConfiguration("parameters")],
        remappings=[
            ("depth/image", LaunchConfiguration("image")),
            ("depth/camera_info", LaunchConfiguration("camera_info")),
            ("points", LaunchConfiguration("points")),
            ("labels", LaunchConfiguration("labels")),
        ],
    )
    config = PathJoinSubstitution([SHARE, "rviz", "graspd.rviz"])
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", config, "-f", LaunchConfiguration("fixed_frame")],
        remappings=[("points", LaunchConfiguration("points"))],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    arguments = [DeclareLaunchArgument(name, default_value=value, description=help) for name, value, help in ARGUMENTS]
    return LaunchDescription([*arguments, node, rviz])
