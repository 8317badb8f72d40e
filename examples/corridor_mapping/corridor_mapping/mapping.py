"""The whole experiment as one command: simulator and mapper together, until the map is saved and
scored.

    mapping [--activate]
            [--ros-args -p simulator:seed:=2 -p simulator:rate:=8.0 -p mapper:particles:=30]

The robot sets off when /mapper is active. Another program activates it, or this command with
--activate.
Both nodes share one executor, so the robot waits for the mapper and not the other way round: a busy
machine takes longer, and the map is the same.
"""

import argparse
import signal
import sys

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from corridor_mapping import score
from corridor_mapping.mapper import Mapper
from corridor_mapping.simulator import Simulator


def main():
    description = "Drives through the simulated corridor and maps it."
    parser = argparse.ArgumentParser(description=description)
    help_text = "configure and activate /mapper instead of waiting for it"
    parser.add_argument("--activate", action="store_true", help=help_text)
    arguments = parser.parse_args(remove_ros_args(sys.argv)[1:])
    # A signal ends the run between two callbacks; rclpy's own handlers would take ROS away in the
    # middle of one.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    outcome = Future()

    def end(problem):
        if not outcome.done():
            outcome.set_result(problem)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: end("stopped before the drive was over"))
    mapper, simulator = Mapper(on_end=end), Simulator()
    executor = SingleThreadedExecutor()
    executor.add_node(mapper)
    executor.add_node(simulator)
    if arguments.activate:
        for transition in (mapper.trigger_configure, mapper.trigger_activate):
            if transition() != TransitionCallbackReturn.SUCCESS:
                sys.exit("mapping: /mapper could not be activated")
    executor.spin_until_future_complete(outcome)
    if mapper.active:
        # Has an effect only if the run was stopped: the unfinished map is saved.
        mapper.save()
    executor.shutdown()
    rclpy.shutdown()
    if outcome.result() is not None:
        sys.exit(f"mapping: {outcome.result()}")
    try:
        print(score.report(score.score_files(mapper.get_parameter("map_dir").value)), flush=True)
    except OSError as error:
        sys.exit(f"mapping: the score could not be saved: {error}")


if __name__ == "__main__":
    main()
