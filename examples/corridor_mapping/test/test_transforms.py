"""What is said over TF, told to a stand-in where `tf2_msgs` is not installed."""

import types
import unittest
from unittest import mock

import numpy as np
from builtin_interfaces.msg import Time

from corridor_mapping import transforms


class Transforms(unittest.TestCase):
    def test_headings_survive_as_quaternions(self):
        for heading in (-3.0, 0.0, 0.5, 3.1):
            self.assertAlmostEqual(transforms.heading_of(transforms.quaternion(heading)), heading)

    def test_a_transform_names_its_frames(self):
        node = mock.Mock()
        with mock.patch.object(transforms, "TFMessage", types.SimpleNamespace):
            broadcaster = transforms.Broadcaster(node, static=True)
            broadcaster.send(Time(sec=3), "map", "odom", np.array([1.0, -2.0, np.pi]))
        self.assertEqual(node.create_publisher.call_args.args[1], "/tf_static")
        (transform,) = broadcaster.publisher.publish.call_args.args[0].transforms
        self.assertEqual((transform.header.frame_id, transform.child_frame_id), ("map", "odom"))
        self.assertEqual((transform.header.stamp.sec, transform.transform.translation.y), (3, -2.0))
        self.assertAlmostEqual(transform.transform.rotation.z, 1.0)

    def test_without_the_message_nothing_is_sent(self):
        node = mock.Mock()
        with mock.patch.object(transforms, "TFMessage", None):
            broadcaster = transforms.Broadcaster(node)
            broadcaster.send(Time(), "map", "odom", np.zeros(3))
        node.create_publisher.assert_not_called()


if __name__ == "__main__":
    unittest.main()
