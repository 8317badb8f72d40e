"""A lifecycle node that refuses to be configured while its parameter "broken" is true. It leaves
when its input ends."""
import sys
import threading

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import Node, TransitionCallbackReturn


class Managed(Node):
    def __init__(self):
        super().__init__("mapper")
        self.declare_parameter("broken", False)

    def on_configure(self, state):
        if self.get_parameter("broken").value:
            return TransitionCallbackReturn.FAILURE
        return super().on_configure(state)


def leave():
    sys.stdin.read()
    rclpy.try_shutdown()


rclpy.init(args=sys.argv)
node = Managed()
# Before anybody may end it all: an executor cannot be made in a context that is shut down.
executor = SingleThreadedExecutor()
executor.add_node(node)
threading.Thread(target=leave, daemon=True).start()
print("up", flush=True)
try:
    executor.spin()
except (ExternalShutdownException, KeyboardInterrupt):
    pass
rclpy.try_shutdown()
