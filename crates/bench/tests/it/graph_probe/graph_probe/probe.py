"""A node that does what its arguments say; on SIGUSR1 it breaks a promise in the way `--breaks`
says.

`--below` runs the node in a child process, as a launch file does; `--respawn` starts a new child
when one ends.
"""
import argparse
import os
import signal
import subprocess
import sys
import threading

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger


class Endpoints:
    """What both kinds of node have."""

    def set_up(self, arguments):
        self.arguments = arguments
        self.broken = threading.Event()
        self.declare_parameter("resolution", 0.05)
        self.add_on_set_parameters_callback(self.check)
        if arguments.service:
            self.service = self.create_service(Trigger, arguments.service, self.on_say)
        if arguments.topic:
            self.topic = self.create_publisher(String, arguments.topic, 10)
            tick = String(data="tick")
            self.ticks = self.create_timer(1 / arguments.hz, lambda: self.topic.publish(tick))
        self.create_timer(0.05, self.break_promise)

    def check(self, parameters):
        for parameter in parameters:
            if parameter.name == "resolution" and parameter.value <= 0:
                return SetParametersResult(successful=False, reason="must be positive")
        return SetParametersResult(successful=True)

    def on_say(self, _request, response):
        self.get_logger().warning("I was asked")
        response.success = True
        response.message = str(self.get_parameter("resolution").value)
        return response

    def break_promise(self):
        if not self.broken.is_set():
            return
        self.broken.clear()
        match self.arguments.breaks:
            case "crash":
                os._exit(3)
            case "silence":
                self.ticks.cancel()
            case "service":
                self.destroy_service(self.service)
            case "inactive":
                self.trigger_deactivate()


class Plain(Endpoints, Node):
    def __init__(self, arguments):
        super().__init__(arguments.node)
        self.set_up(arguments)


class Managed(Endpoints, LifecycleNode):
    def __init__(self, arguments):
        super().__init__(arguments.node)
        self.set_up(arguments)

    def on_configure(self, state):
        if self.arguments.breaks == "configure":
            return TransitionCallbackReturn.FAILURE
        # A parameter that is declared late, as many nodes do.
        self.declare_parameter("late", 1)
        return super().on_configure(state)

    def on_activate(self, state):
        print(f"activated with late = {self.get_parameter('late').value}", flush=True)
        return super().on_activate(state)

    def on_shutdown(self, state):
        print("shut down in good order", flush=True)
        return super().on_shutdown(state)


def run_below(arguments):
    """Lives on when the node dies, as `ros2 launch` does."""
    own = [argument for argument in sys.argv[1:] if argument not in ("--below", "--respawn")]
    stopped = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    child = subprocess.Popen([sys.argv[0], *own])
    while not stopped.wait(0.05):
        if arguments.respawn and child.poll() is not None:
            child = subprocess.Popen([sys.argv[0], *own])
    if child.poll() is None:
        child.send_signal(signal.SIGINT)
    child.wait()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--node", default="probe")
    parser.add_argument("--lifecycle", action="store_true")
    parser.add_argument("--service")
    parser.add_argument("--topic")
    parser.add_argument("--hz", type=float, default=20)
    parser.add_argument("--breaks")
    parser.add_argument("--below", action="store_true")
    parser.add_argument("--respawn", action="store_true")
    arguments = parser.parse_args()
    if arguments.below:
        run_below(arguments)
        return
    rclpy.init(args=sys.argv[:1])
    node = (Managed if arguments.lifecycle else Plain)(arguments)
    signal.signal(signal.SIGUSR1, lambda *_: node.broken.set())
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
