"""Calls a std_srvs/Trigger service once and prints its message: an independent witness that a node really runs."""
import sys

import rclpy
from std_srvs.srv import Trigger

rclpy.init()
node = rclpy.create_node("trigger_client")
client = node.create_client(Trigger, sys.argv[1])
if not client.wait_for_service(timeout_sec=30):
    sys.exit(f"no service {sys.argv[1]} within 30 s")
future = client.call_async(Trigger.Request())
rclpy.spin_until_future_complete(node, future, timeout_sec=10)
answer = future.result()
if answer is None or not answer.success:
    sys.exit(f"{sys.argv[1]} did not answer: {answer}")
print(answer.message)
rclpy.shutdown()
