"""Simulator and mapper as two processes; the mapper waits to be configured and activated, the robot
for the first map."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode, Node
from launch_ros.parameter_descriptions import ParameterValue


def number(name, kind):
    return ParameterValue(LaunchConfiguration(name), value_type=kind)


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "seed",
                default_value="1",
                description="decides the errors of odometry and lidar",
            ),
            DeclareLaunchArgument(
                "rate",
                default_value="4.0",
                description="how much faster than real time",
            ),
            DeclareLaunchArgument(
                "map_dir",
                default_value="maps",
                description="where the map is saved",
            ),
            Node(
                package="corridor_mapping",
                executable="simulator",
                name="simulator",
                parameters=[{"seed": number("seed", int), "rate": number("rate", float)}],
            ),
            LifecycleNode(
                package="corridor_mapping",
                executable="mapper",
                name="mapper",
                namespace="",
                parameters=[{"map_dir": LaunchConfiguration("map_dir")}],
            ),
        ]
    )
