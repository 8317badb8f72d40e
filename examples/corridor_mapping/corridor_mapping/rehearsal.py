"""The experiment without ROS and without waiting: the same robot and the same mapper, with a score
for each seed.

    python3 -m corridor_mapping.rehearsal 1 2 3 4 5
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from corridor_mapping import score, world
from corridor_mapping.mapping_run import MappingRun
from corridor_mapping.particle_filter import Settings
from corridor_mapping.simulation import Simulation


def rehearse(seed, settings, steps=None):
    """Drives all of the way, or so many steps of it; the run and how far off the filter was at each
    scan used, in metres."""
    simulation = Simulation(seed)
    run = MappingRun(settings, world.LIDAR.bearings(), world.LIDAR.mount)
    errors = []
    while not simulation.finished and (steps is None or simulation.ticks < steps):
        moment = simulation.step(drives=simulation.ticks > 0)
        if moment.ranges is not None and run.hear(moment.odometry, moment.ranges):
            errors.append(np.hypot(*(run.filter.pose - simulation.pose)[:2]))
    return run, errors


def main():
    parser = argparse.ArgumentParser(description="Maps the simulated corridor without ROS.")
    seeds_help = "of the robot's errors and of the filter"
    parser.add_argument("seeds", type=int, nargs="*", default=[1], help=seeds_help)
    for seed in parser.parse_args().seeds:
        run, errors = rehearse(seed, Settings(seed=seed))
        with tempfile.TemporaryDirectory() as directory:
            run.save(Path(directory))
            figures = score.score_files(directory)
        off = f"off by {np.mean(errors):.3f} m, at most {np.max(errors):.3f} m"
        print(f"seed {seed}: {run.filter.scans_used} scans, {off}")
        print(score.report(figures), flush=True)


if __name__ == "__main__":
    main()
