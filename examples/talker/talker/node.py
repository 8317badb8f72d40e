"""A node that says something every period and, when asked by the service `say`, at once.

Several robots on one machine keep apart by ROS_DOMAIN_ID, or by ROS's own arguments, for example
`talker --ros-args -r __ns:=/robot_1 -p period_s:=0.5`.
"""

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger


class Talker(Node):
    """Publishes on `chatter` and serves `say`."""

    def __init__(self):
        super().__init__("talker")
        period_s = self.declare_parameter("period_s", 1.0).value
        if period_s <= 0:
            raise ValueError(f"period_s is {period_s}, must be above 0")
        self.said = 0
        self.publisher = self.create_publisher(String, "chatter", 10)
        self.timer = self.create_timer(period_s, self.say)
        self.service = self.create_service(Trigger, "say", self.on_say)
        self.get_logger().info(f"talking every {period_s} s")

    def say(self):
        self.said += 1
        text = f"hello {self.said}"
        self.publisher.publish(String(data=text))
        return text

    def on_say(self, _request, response):
        response.success = True
        response.message = self.say()
        return response


def main():
    # rclpy's own handlers end `spin` on SIGINT and on SIGTERM.
    rclpy.init()
    node = Talker()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
