"""The node `simulator`: a robot with odometry and a lidar in the corridor.

It stands still until a map is published, drives through both legs and back, reports that on
`drive_finished`, and stands still again. `rate` is the speed of its time relative to wall time.
"""

import array

import numpy as np
import rclpy
from nav_msgs.msg import OccupancyGrid, Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Duration
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Header

from corridor_mapping.simulation import STEP_S, Simulation
from corridor_mapping.transforms import Broadcaster, quaternion

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Simulator(Node):
    """Steps a `Simulation` and publishes what its sensors read."""

    def __init__(self):
        super().__init__("simulator")
        self.simulation = None
        self.drives = False
        self.timer = None
        self.add_on_set_parameters_callback(self.on_set_parameters)
        seed = self.declare_parameter("seed", 1).value
        rate = self.declare_parameter("rate", 4.0).value
        self.simulation = Simulation(seed)
        self.started = self.get_clock().now()
        self.odometry = self.create_publisher(Odometry, "odom", 50)
        self.scan = self.create_publisher(LaserScan, "scan", 50)
        self.finished = self.create_publisher(Header, "drive_finished", LATCHED)
        self.transforms = Broadcaster(self)
        self.static_transforms = Broadcaster(self, static=True)
        mount = self.simulation.lidar.mount
        self.static_transforms.send(self.started.to_msg(), "base_link", "laser", mount)
        self.map = self.create_subscription(OccupancyGrid, "map", self.on_map, LATCHED)
        self.timer = self.create_timer(STEP_S / rate, self.on_timer)

    def on_set_parameters(self, parameters):
        for parameter in parameters:
            if parameter.name == "rate":
                if not 0.1 <= parameter.value <= 20:
                    reason = f"rate is {parameter.value}, must be from 0.1 to 20"
                    return SetParametersResult(reason=reason)
                if self.timer is not None:
                    self.timer.timer_period_ns = round(STEP_S / parameter.value * 1e9)
            elif parameter.name == "seed":
                if not 0 <= parameter.value < 2**31:
                    reason = f"seed is {parameter.value}, must be from 0 to 2147483647"
                    return SetParametersResult(reason=reason)
                if self.drives and parameter.value != self.simulation.seed:
                    reason = "seed can't change any more: the robot has set off"
                    return SetParametersResult(reason=reason)
                if self.simulation is not None and not self.drives:
                    # The robot's clock never goes back.
                    ticks = self.simulation.ticks
                    self.simulation = Simulation(parameter.value)
                    self.simulation.ticks = ticks
        return SetParametersResult(successful=True)

    def on_map(self, _map):
        if not self.drives:
            self.drives = True
            length_s = len(self.simulation.drive) * STEP_S
            self.get_logger().info(f"setting off, for {length_s:.0f} s of the robot's time")

    def on_timer(self):
        was_finished = self.simulation.finished
        moment = self.simulation.step(self.drives)
        stamp = (self.started + Duration(nanoseconds=round(moment.time_s * 1e9))).to_msg()
        self.publish_odometry(stamp, moment)
        if moment.ranges is not None:
            self.publish_scan(stamp, moment.ranges)
        if self.simulation.finished and not was_finished:
            self.get_logger().info("the drive is over")
            self.finished.publish(Header(stamp=stamp, frame_id="odom"))

    def publish_odometry(self, stamp, moment):
        message = Odometry(child_frame_id="base_link")
        message.header = Header(stamp=stamp, frame_id="odom")
        x, y, heading = moment.odometry
        message.pose.pose.position.x, message.pose.pose.position.y = float(x), float(y)
        message.pose.pose.orientation = quaternion(heading)
        message.twist.twist.linear.x = float(moment.speed)
        message.twist.twist.angular.z = float(moment.turn_rate)
        self.odometry.publish(message)
        self.transforms.send(stamp, "odom", "base_link", moment.odometry)

    def publish_scan(self, stamp, ranges):
        lidar = self.simulation.lidar
        bearings = lidar.bearings()
        self.scan.publish(
            LaserScan(
                header=Header(stamp=stamp, frame_id="laser"),
                angle_min=float(bearings[0]),
                angle_max=float(bearings[-1]),
                angle_increment=float(bearings[1] - bearings[0]),
                scan_time=lidar.period_s,
                range_min=lidar.min_range,
                range_max=lidar.max_range,
                ranges=array.array("f", ranges.astype(np.float32).tobytes()),
            )
        )


def main():
    rclpy.init()
    node = Simulator()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
