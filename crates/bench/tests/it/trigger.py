"""Calls a std_srvs/Trigger service and prints its message: an independent witness that a node
really runs.

An answer may be lost while the server does not know this client yet, so it is asked again."""
import sys
import time

import rclpy
from std_srvs.srv import Trigger

rclpy.init()
node = rclpy.create_node("trigger_client")
client = node.create_client(Trigger, sys.argv[1])
if not client.wait_for_service(timeout_sec=90):
    sys.exit(f"no service {sys.argv[1]} within 90 s")
answer, until = None, time.monotonic() + 60
while answer is None and time.monotonic() < until:
    future = client.call_async(Trigger.Request())
    rclpy.spin_until_future_complete(node, future, timeout_sec=5)
    answer = future.result()
if answer is None or not answer.success:
    sys.exit(f"{sys.argv[1]} did not answer: {answer}")
print(answer.message)
rclpy.shutdown()
