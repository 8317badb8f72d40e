"""The true world, as data: the corridor's walls, the way the robot drives, and what its lidar can
do.

The simulator drives in it and the score compares maps with it; the mapper never sees it. Lengths
are in metres. All of it is given in the map's frame, which is where the robot starts: at (0, 0),
looking along x.
"""

from dataclasses import dataclass

import numpy as np

# Where the robot starts, in the plan's own coordinates. Odd on purpose: walls must not fall on the
# edges of map cells.
START = np.array([1.03, 1.12])

# The way through both legs and back, in the plan's coordinates.
WAYPOINTS = np.array(
    [
        [5.0, 1.0],
        [9.5, 1.2],
        [13.5, 1.05],
        [16.9, 1.1],
        [16.8, 5.0],
        [17.0, 8.5],
        [16.9, 11.8],
        [16.8, 7.0],
        [16.9, 1.2],
        [12.0, 1.15],
        [7.0, 1.0],
        [1.1, 1.1],
    ]
)


@dataclass(frozen=True)
class Lidar:
    """A lidar that looks all around, as small robots carry them."""

    beams: int = 360
    min_range: float = 0.12
    max_range: float = 8.0
    period_s: float = 0.1
    range_noise: float = 0.015
    dropout: float = 0.01
    mount: tuple = (0.10, 0.0, 0.0)  # x, y and heading on the robot

    def bearings(self):
        return -np.pi + 2 * np.pi * np.arange(self.beams) / self.beams


LIDAR = Lidar()


def wall(start, end, *recesses):
    """The corners of a wall from start to end, the corridor on its left.

    A recess (from, to, depth), measured along the wall, is a door or a niche; with a negative depth
    it is a pillar.
    """
    start, end = np.array(start, float), np.array(end, float)
    along = (end - start) / np.linalg.norm(end - start)
    outward = np.array([along[1], -along[0]])
    corners = [start]
    for begin, finish, depth in recesses:
        for distance, out in [(begin, 0), (begin, depth), (finish, depth), (finish, 0)]:
            corners.append(start + along * distance + outward * out)
    return corners


def plan():
    """The closed outline of the corridor, counter-clockwise, in the plan's coordinates."""
    lower = [(3.0, 4.0, 0.2), (6.9, 7.2, -0.2), (8.5, 9.5, 0.2), (13.0, 13.9, 0.2)]
    upper = [(3.6, 4.6, 0.2), (6.8, 7.1, -0.2), (9.2, 10.6, 0.8), (13.1, 14.0, 0.2)]
    return np.array(
        wall((0.0, 0.0), (18.0, 0.0), *lower)
        + wall((18.0, 0.0), (18.0, 13.0), (3.0, 4.0, 0.2), (6.2, 7.6, 0.8), (10.0, 11.0, 0.2))
        + wall((18.0, 13.0), (15.8, 13.0), (0.5, 1.4, 0.2))
        + wall((15.8, 13.0), (15.8, 2.2), (1.7, 2.7, 0.2), (4.9, 5.9, 0.2), (8.0, 8.3, -0.2))
        + wall((15.8, 2.2), (0.0, 2.2), *upper)
        + wall((0.0, 2.2), (0.0, 0.0))
    )


def walls():
    """All walls as segments in the map's frame: an array (segment, end, coordinate)."""
    corners = plan() - START
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def waypoints():
    """The robot's way in the map's frame."""
    return WAYPOINTS - START
