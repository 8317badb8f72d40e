"""TF, where the robot has `tf2_msgs`: the transforms between the frames map, odom, base_link and
laser.

Nothing here depends on TF: all that it says is in other topics and parameters too. So a robot
without `tf2_msgs` maps as well, and only those who draw pictures of it miss something.
"""

import numpy as np
from geometry_msgs.msg import Quaternion, TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile

try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

STATIC = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def quaternion(heading):
    return Quaternion(z=float(np.sin(heading / 2)), w=float(np.cos(heading / 2)))


def heading_of(orientation):
    """The turn about the vertical axis."""
    q = orientation
    return np.arctan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))


class Broadcaster:
    """Publishes transforms on one of TF's two topics, or nothing."""

    def __init__(self, node, static=False):
        self.publisher = None
        if TFMessage is None:
            node.get_logger().info("no tf2_msgs here: transforms are not published")
        else:
            topic, qos = ("/tf_static", STATIC) if static else ("/tf", 100)
            self.publisher = node.create_publisher(TFMessage, topic, qos)

    def send(self, stamp, parent, child, pose):
        if self.publisher is None:
            return
        transform = TransformStamped(child_frame_id=child)
        transform.header.stamp, transform.header.frame_id = stamp, parent
        translation = transform.transform.translation
        translation.x, translation.y = float(pose[0]), float(pose[1])
        transform.transform.rotation = quaternion(pose[2])
        self.publisher.publish(TFMessage(transforms=[transform]))

    def close(self, node):
        if self.publisher is not None:
            node.destroy_publisher(self.publisher)
