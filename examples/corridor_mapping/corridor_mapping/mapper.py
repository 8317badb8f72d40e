"""The lifecycle node `mapper`: draws a map from a lidar's scans and odometry.

It subscribes to `scan` and `odom`, publishes `map`, its `pose` in the map and the transform from
map to odom, and saves the map when the drive is over (`drive_finished`), when it is deactivated,
and when it is shut down.
"""

import array
import math
from collections import deque
from pathlib import Path

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Header

from corridor_mapping.geometry import between, compose, inverse
from corridor_mapping.grid_maps import MapTooLarge
from corridor_mapping.mapping_run import MappingRun
from corridor_mapping.particle_filter import Settings
from corridor_mapping.transforms import Broadcaster, heading_of, quaternion

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Best effort, because that matches lidars of both kinds; deep, so that a slow machine falls behind
# rather than miss scans.
SENSOR = QoSProfile(depth=2000, reliability=ReliabilityPolicy.BEST_EFFORT)
ODOMETRY_KEPT, SCANS_KEPT = 2000, 2000
SCANS_PER_MAP, SCANS_PER_LOG = 10, 25
# Least, greatest, unit.
LIMITS = {
    "resolution": (0.02, 0.5, " m"),
    "particles": (1, 100, ""),
    "seed": (0, 2**31 - 1, ""),
    "max_range": (1.0, 100.0, " m"),
    "step_m": (0.02, 2.0, " m"),
    "step_rad": (0.02, 3.0, " rad"),
}


class Mapper(LifecycleNode):
    """Feeds a `MappingRun`. `on_end` is called once, with None when the map is saved or with what
    went wrong."""

    def __init__(self, on_end=lambda problem: None):
        super().__init__("mapper")
        self.on_end = on_end
        self.settings = None
        self.active = False
        self.forget()
        self.add_on_set_parameters_callback(self.on_set_parameters)
        for name in LIMITS:
            self.declare_parameter(name, getattr(Settings, name))
        self.declare_parameter("map_dir", "maps")
        self.declare_parameter("laser_mount", [0.1, 0.0, 0.0])

    def forget(self):
        """Drops what was heard so far."""
        self.run = None
        self.ended = False
        self.geometry = None
        self.drive_ended_at = None
        self.odometry = deque(maxlen=ODOMETRY_KEPT)
        self.scans = deque(maxlen=SCANS_KEPT)

    def on_set_parameters(self, parameters):
        for parameter in parameters:
            problem = self.problem_with(parameter)
            if problem:
                return SetParametersResult(reason=problem)
        return SetParametersResult(successful=True)

    def problem_with(self, parameter):
        name, value = parameter.name, parameter.value
        if name in LIMITS:
            least, greatest, unit = LIMITS[name]
            if not least <= value <= greatest:
                return f"{name} is {value}, must be from {least} to {greatest}{unit}"
        elif name == "map_dir" and (not value or "\0" in value):
            return "map_dir must name a directory"
        elif name == "laser_mount" and (len(value) != 3 or not all(map(math.isfinite, value))):
            return "laser_mount must be three finite numbers: x, y and heading on the robot"
        configured = self.settings is not None and (name in LIMITS or name == "laser_mount")
        if configured and value != self.get_parameter(name).value:
            return f"{name} can't change while /mapper is configured: clean it up first"
        return None

    # Transitions.

    def on_configure(self, state):
        self.settings = Settings(**{name: self.get_parameter(name).value for name in LIMITS})
        self.mount = np.array(self.get_parameter("laser_mount").value)
        self.map = self.create_lifecycle_publisher(OccupancyGrid, "map", LATCHED)
        self.pose = self.create_lifecycle_publisher(PoseStamped, "pose", 10)
        self.transforms = Broadcaster(self)
        self.heard = [
            self.create_subscription(Odometry, "odom", self.on_odometry, SENSOR),
            self.create_subscription(LaserScan, "scan", self.on_scan, SENSOR),
            self.create_subscription(Header, "drive_finished", self.on_drive_finished, LATCHED),
        ]
        return super().on_configure(state)

    def on_activate(self, state):
        self.active = True
        self.get_logger().info(f"mapping with {self.settings.particles} particles")
        return super().on_activate(state)

    def on_deactivate(self, state):
        self.active = False
        saved = self.save()
        super().on_deactivate(state)
        return TransitionCallbackReturn.SUCCESS if saved else TransitionCallbackReturn.FAILURE

    def on_cleanup(self, state):
        self.leave()
        return super().on_cleanup(state)

    def on_shutdown(self, state):
        if self.active:
            self.active = False
            self.save()
        if self.settings is not None:
            self.leave()
        return super().on_shutdown(state)

    def leave(self):
        """Undoes `on_configure`."""
        for subscription in self.heard:
            self.destroy_subscription(subscription)
        self.destroy_lifecycle_publisher(self.map)
        self.destroy_lifecycle_publisher(self.pose)
        self.transforms.close(self)
        self.settings = None
        self.forget()

    # Subscriptions.

    def on_odometry(self, message):
        position, orientation = message.pose.pose.position, message.pose.pose.orientation
        pose = np.array([position.x, position.y, heading_of(orientation)])
        if not np.isfinite(pose).all():
            return
        time = Time.from_msg(message.header.stamp).nanoseconds
        if self.odometry and time <= self.odometry[-1][0]:
            return
        self.odometry.append((time, pose))
        self.map_pending()

    def on_scan(self, message):
        if self.active and not self.ended:
            self.scans.append(message)
            self.map_pending()

    def on_drive_finished(self, message):
        self.drive_ended_at = Time.from_msg(message.stamp).nanoseconds

    def map_pending(self):
        """Uses the scans for which there is odometry from both before and after."""
        while self.active and not self.ended and self.scans and self.odometry:
            scan = self.scans[0]
            time = Time.from_msg(scan.header.stamp).nanoseconds
            if time > self.odometry[-1][0]:
                return
            self.scans.popleft()
            if time < self.odometry[0][0]:
                continue
            try:
                self.use(scan, self.odometry_at(time))
            except MapTooLarge as error:
                self.end(f"the map grew too large: {error}")
            if self.drive_ended_at is not None and time >= self.drive_ended_at:
                self.end(None)

    def odometry_at(self, time):
        """The odometry's pose at a time within what is kept."""
        after = next(i for i, (stamp, _) in enumerate(self.odometry) if stamp >= time)
        late, end = self.odometry[after]
        if late == time:
            return end
        early, begin = self.odometry[after - 1]
        return compose(begin, between(begin, end) * (time - early) / (late - early))

    def use(self, scan, odometry):
        geometry = (scan.angle_min, scan.angle_increment, len(scan.ranges))
        if self.run is None:
            angles = (scan.angle_min, scan.angle_increment)
            if not scan.ranges or not all(map(math.isfinite, angles)):
                return
            self.geometry = geometry
            bearings = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
            self.run = MappingRun(self.settings, bearings, self.mount)
        if geometry != self.geometry:
            problem = "a scan with other beams than the first is left out"
            self.get_logger().warning(problem, throttle_duration_sec=5.0)
            return
        ranges = np.frombuffer(scan.ranges, np.float32)
        if not self.run.hear(odometry, ranges):
            return
        used = self.run.filter.scans_used
        self.publish_pose(scan.header.stamp, odometry)
        if used % SCANS_PER_MAP == 1:
            self.publish_map(scan.header.stamp)
        if used % SCANS_PER_LOG == 0:
            self.get_logger().info(f"{used} scans in the map")

    # Publications.

    def publish_pose(self, stamp, odometry):
        pose = self.run.filter.pose
        message = PoseStamped(header=Header(stamp=stamp, frame_id="map"))
        message.pose.position.x, message.pose.position.y = float(pose[0]), float(pose[1])
        message.pose.orientation = quaternion(pose[2])
        self.pose.publish(message)
        self.transforms.send(stamp, "map", "odom", compose(pose, inverse(odometry)))

    def publish_map(self, stamp):
        maps, best = self.run.filter.maps, self.run.filter.best
        probability, known = maps.probability(best)
        message = OccupancyGrid(header=Header(stamp=stamp, frame_id="map"))
        message.info.map_load_time = stamp
        message.info.resolution = maps.resolution
        message.info.height, message.info.width = probability.shape
        message.info.origin.position.x, message.info.origin.position.y = map(float, maps.origin)
        message.info.origin.orientation.w = 1.0
        percent = np.where(known, np.rint(probability * 100), -1).astype(np.int8)
        message.data = array.array("b", percent.tobytes())
        self.map.publish(message)

    def save(self):
        """Saves what there is; says whether that went well."""
        if self.run is None or self.ended:
            return True
        directory = Path(self.get_parameter("map_dir").value)
        try:
            self.run.save(directory)
        except OSError as error:
            self.get_logger().error(f"could not save the map in {directory}: {error}")
            return False
        self.get_logger().info(f"{self.run.filter.scans_used} scans, map saved in {directory}")
        return True

    def end(self, problem):
        """The drive is over, or nothing more can be mapped: saves and says so, once."""
        if self.ended:
            return
        if self.run is None:
            problem = problem or "the drive is over and no scan could be used"
        else:
            self.publish_map(self.get_clock().now().to_msg())
        if not self.save():
            problem = problem or "the map could not be saved"
        if problem:
            self.get_logger().error(problem)
        self.ended = True
        self.on_end(problem)


def main():
    rclpy.init()
    node = Mapper()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node.active:
            node.save()
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
