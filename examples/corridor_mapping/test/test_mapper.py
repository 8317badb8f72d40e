"""The lifecycle node, with real rclpy: its refusals, and the times of its saves."""

import array
import os
import tempfile
import unittest
from pathlib import Path

# The nodes need no discovery. With LOCALHOST they would share memory in spite of
# FASTDDS_BUILTIN_TRANSPORTS.
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "OFF"

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Header

from corridor_mapping import map_file
from corridor_mapping.mapper import Mapper
from corridor_mapping.simulator import Simulator

BEAMS = 90
SUCCESS = TransitionCallbackReturn.SUCCESS


def scan(second, beams=BEAMS):
    header = Header(stamp=Time(sec=second), frame_id="laser")
    ranges = array.array("f", [2.0] * beams)
    return LaserScan(header=header, angle_min=-3.0, angle_increment=6.0 / BEAMS, ranges=ranges)


def odometry(second, x=0.0):
    message = Odometry(header=Header(stamp=Time(sec=second)))
    message.pose.pose.position.x = x
    message.pose.pose.orientation.w = 1.0
    return message


class Nodes(unittest.TestCase):
    def setUp(self):
        directory = tempfile.TemporaryDirectory()
        self.addCleanup(directory.cleanup)
        self.maps = Path(directory.name) / "maps"
        rclpy.init(domain_id=87)
        self.addCleanup(rclpy.try_shutdown)
        self.ends = []

    def mapper(self):
        mapper = Mapper(on_end=self.ends.append)
        self.addCleanup(mapper.destroy_node)
        self.refused(mapper, None, map_dir=str(self.maps), particles=2)
        return mapper

    def active_mapper(self):
        mapper = self.mapper()
        results = [mapper.trigger_configure(), mapper.trigger_activate()]
        self.assertEqual(results, [SUCCESS, SUCCESS])
        return mapper

    def refused(self, node, reason, **values):
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        result = node.set_parameters_atomically(parameters)
        self.assertEqual((result.successful, result.reason), (reason is None, reason or ""))

    def test_nonsense_is_refused_with_the_reason(self):
        mapper = self.mapper()
        self.refused(mapper, "resolution is 7.0, must be from 0.02 to 0.5 m", resolution=7.0)
        reason = "resolution is nan, must be from 0.02 to 0.5 m"
        self.refused(mapper, reason, resolution=float("nan"))
        self.refused(mapper, "particles is 0, must be from 1 to 100", particles=0)
        self.refused(mapper, "map_dir must name a directory", map_dir="")
        reason = "laser_mount must be three finite numbers: x, y and heading on the robot"
        self.refused(mapper, reason, laser_mount=[0.0, 1.0])

    def test_what_the_map_is_made_with_stays_while_it_is_made(self):
        mapper = self.active_mapper()
        reason = "resolution can't change while /mapper is configured: clean it up first"
        self.refused(mapper, reason, resolution=0.1)
        self.refused(mapper, None, resolution=0.05, map_dir=str(self.maps))
        results = [mapper.trigger_deactivate(), mapper.trigger_cleanup()]
        self.assertEqual(results, [SUCCESS, SUCCESS])
        self.refused(mapper, None, resolution=0.1)
        self.assertEqual(mapper.trigger_configure(), SUCCESS)

    def test_the_map_is_saved_when_the_drive_is_over(self):
        mapper = self.active_mapper()
        mapper.on_odometry(odometry(1))
        mapper.on_scan(scan(1))
        mapper.on_scan(scan(3))
        mapper.on_drive_finished(Header(stamp=Time(sec=3)))
        # The scan of the last moment waits for the odometry of its time.
        self.assertEqual(self.ends, [])
        mapper.on_odometry(odometry(2, 0.3))
        self.assertEqual(self.ends, [])
        mapper.on_odometry(odometry(4, 0.5))
        self.assertEqual(self.ends, [None])
        self.assertEqual(mapper.run.filter.scans_used, 2)
        corridor = map_file.load(self.maps / "corridor.yaml")
        self.assertGreater((corridor.cells == map_file.OCCUPIED).sum(), BEAMS / 2)
        self.assertTrue((self.maps / "odometry.pgm").exists())

    def test_the_map_so_far_is_saved_on_deactivation(self):
        mapper = self.active_mapper()
        mapper.on_odometry(odometry(1))
        mapper.on_scan(scan(1))
        self.assertFalse(self.maps.exists())
        self.assertEqual(mapper.trigger_deactivate(), SUCCESS)
        self.assertTrue((self.maps / "corridor.pgm").exists())

    def test_an_inactive_mapper_hears_nothing(self):
        mapper = self.mapper()
        mapper.trigger_configure()
        mapper.on_odometry(odometry(1))
        mapper.on_scan(scan(1))
        self.assertIsNone(mapper.run)

    def test_a_map_that_can_not_be_saved_fails_the_run(self):
        self.maps.write_text("in the way")
        mapper = self.active_mapper()
        mapper.on_odometry(odometry(1))
        mapper.on_scan(scan(1))
        mapper.end(None)
        self.assertEqual(self.ends, ["the map could not be saved"])

    def test_a_drive_without_scans_fails_the_run(self):
        mapper = self.active_mapper()
        mapper.on_drive_finished(Header(stamp=Time(sec=1)))
        mapper.on_odometry(odometry(1))
        mapper.on_scan(scan(1, beams=0))
        mapper.end("asked twice")
        self.assertEqual(self.ends, ["the drive is over and no scan could be used"])

    def test_odd_messages_do_no_harm(self):
        mapper = self.active_mapper()
        mapper.on_odometry(odometry(1, float("nan")))
        mapper.on_odometry(odometry(2))
        mapper.on_scan(scan(2, beams=0))
        mapper.on_scan(scan(1))
        self.assertIsNone(mapper.run)
        mapper.on_scan(scan(2))
        mapper.on_odometry(odometry(3, 1.0))
        mapper.on_scan(scan(3, beams=7))
        self.assertEqual(mapper.run.filter.scans_used, 1)

    def test_odometry_is_taken_between_two_readings(self):
        mapper = self.active_mapper()
        mapper.on_odometry(odometry(1))
        mapper.on_odometry(odometry(3, 1.0))
        np.testing.assert_allclose(mapper.odometry_at(1_500_000_000), [0.25, 0, 0])

    def test_the_robot_keeps_its_seed_once_it_drives(self):
        simulator = Simulator()
        self.addCleanup(simulator.destroy_node)
        simulator.on_timer()
        self.refused(simulator, None, seed=4)
        self.assertEqual(simulator.simulation.ticks, 1)
        self.assertEqual(simulator.simulation.seed, 4)
        self.refused(simulator, "rate is 0.0, must be from 0.1 to 20", rate=0.0)
        simulator.on_map(None)
        self.refused(simulator, "seed can't change any more: the robot has set off", seed=5)
        self.refused(simulator, None, rate=2.0, seed=4)


if __name__ == "__main__":
    unittest.main()
