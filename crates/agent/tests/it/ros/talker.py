"""A node with a bit of everything: topics, a service, parameters it may refuse, log lines,
diagnostics.

It does what its standard input says, a line at a time, and prints "up" when it is there; it leaves
when the input ends.
"""
import sys
import threading

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import String
from std_srvs.srv import Trigger

rclpy.init(args=sys.argv)
node = rclpy.create_node("talker")


def allow(parameters):
    for parameter in parameters:
        if parameter.name == "rate" and parameter.value <= 0.0:
            return SetParametersResult(successful=False, reason="rate must be above 0")
    return SetParametersResult(successful=True)


node.declare_parameter("rate", 1.5)
node.declare_parameter("mode", "idle")
node.declare_parameter("gains", [1, 2, 3])
node.add_on_set_parameters_callback(allow)
chatter = node.create_publisher(String, "chatter", 10)
scan = node.create_publisher(String, "scan", qos_profile_sensor_data)
node.create_timer(0.05, lambda: chatter.publish(String(data="hello")))
node.create_timer(0.1, lambda: scan.publish(String(data="x" * 5000)))
node.create_subscription(String, "orders", lambda message: None, 10)
said = Trigger.Response(success=True, message="said")
node.create_service(Trigger, "say", lambda request, answer: said)
node.create_client(Trigger, "ask")
diagnostics = node.create_publisher(DiagnosticArray, "/diagnostics", 10)


def obey():
    for line in sys.stdin:
        verb, _, text = line.strip().partition(" ")
        if verb == "log":
            node.get_logger().info(text)
        elif verb == "warn":
            node.get_logger().warning(text)
        elif verb == "diagnose":
            values = [KeyValue(key="volts", value="11.1")]
            status = DiagnosticStatus(
                level=DiagnosticStatus.WARN,
                name="battery",
                message=text,
                hardware_id="b1",
                values=values,
            )
            diagnostics.publish(DiagnosticArray(status=[status]))
        print("done", flush=True)
    rclpy.try_shutdown()


node.get_logger().info("talker is up")
# Before anybody may end it all: an executor cannot be made in a context that is shut down.
executor = SingleThreadedExecutor()
executor.add_node(node)
threading.Thread(target=obey, daemon=True).start()
print("up", flush=True)
try:
    executor.spin()
except (ExternalShutdownException, KeyboardInterrupt):
    pass
rclpy.try_shutdown()
