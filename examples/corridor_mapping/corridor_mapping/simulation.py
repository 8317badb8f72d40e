"""The simulated robot without ROS: the drive, the odometry and the lidar.

The true way is the same in every run; a seed decides the errors of odometry and lidar.
"""

from dataclasses import dataclass

import numpy as np

from corridor_mapping import world
from corridor_mapping.geometry import between, compose, wrap

STEP_S = 0.05
SPEED = 0.5  # m/s
TURN_RATE = 0.8  # rad/s
ARRIVED_M = 0.25


@dataclass
class Moment:
    """What the robot's sensors say at one time, in seconds since the robot was switched on."""

    time_s: float
    odometry: np.ndarray
    speed: float
    turn_rate: float
    ranges: np.ndarray | None  # None between two turns of the lidar


def true_drive():
    """The robot's true poses and commands, one row a step: x, y, heading, speed, turn rate."""
    pose, rows = np.zeros(3), []
    for target in world.waypoints():
        while np.hypot(*(target - pose[:2])) > ARRIVED_M:
            off = wrap(np.arctan2(*(target - pose[:2])[::-1]) - pose[2])
            turn_rate = np.clip(2 * off, -TURN_RATE, TURN_RATE)
            speed = SPEED * np.cos(off) if abs(off) < 0.6 else 0.0
            rows.append([*pose, speed, turn_rate])
            # The chord of the small arc driven in one step.
            middle = compose(pose, [0, 0, turn_rate * STEP_S / 2])
            pose = compose(middle, [speed * STEP_S, 0, turn_rate * STEP_S / 2])
    rows.append([*pose, 0.0, 0.0])
    return np.array(rows)


def cast(walls, origin, bearings, max_range):
    """How far each ray from `origin` (x, y) goes until it meets a wall; infinity beyond
    `max_range`."""
    directions = np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)[:, None]
    begins, edges = walls[:, 0] - origin, walls[:, 1] - walls[:, 0]
    cross = directions[..., 0] * edges[:, 1] - directions[..., 1] * edges[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (begins[:, 0] * edges[:, 1] - begins[:, 1] * edges[:, 0]) / cross
        where = (begins[:, 0] * directions[..., 1] - begins[:, 1] * directions[..., 0]) / cross
        meets = (distance > 0) & (where >= 0) & (where <= 1)
    nearest = np.where(meets, distance, np.inf).min(axis=1)
    return np.where(nearest <= max_range, nearest, np.inf)


class Simulation:
    """Steps through the drive and says what the sensors read."""

    def __init__(self, seed, lidar=world.LIDAR):
        self.seed = seed
        self.lidar = lidar
        self.walls = world.walls()
        self.drive = true_drive()
        self.ticks = 0
        self.steps_driven = 0
        self.odometry = np.zeros(3)
        # Wheels wear: each run has its own wrong scale, and veers to one side.
        random = np.random.default_rng(seed)
        self.scale = 1 + random.choice([-1, 1]) * random.uniform(0.01, 0.03)
        self.veer = random.choice([-1, 1]) * random.uniform(0.006, 0.014)  # rad/m

    @property
    def finished(self):
        return self.steps_driven == len(self.drive) - 1

    @property
    def pose(self):
        """Where the robot truly is."""
        return self.drive[self.steps_driven, :3]

    def step(self, drives=True):
        """The next moment; the robot stands still until it drives and when the drive is over, and
        its sensors go on."""
        drives = drives and not self.finished
        self.steps_driven += drives
        # Errors depend on the seed and the place on the way alone, not on how long the robot stood
        # before it.
        random = np.random.default_rng([self.seed, self.steps_driven])
        speed, turn_rate = self.drive[self.steps_driven - 1, 3:] if drives else (0.0, 0.0)
        if drives:
            self._roll(between(self.drive[self.steps_driven - 1, :3], self.pose), random)
        turned = (self.steps_driven if drives else self.ticks) % self.steps_per_turn == 0
        scan = self._scan(random) if turned else None
        moment = Moment(self.ticks * STEP_S, self.odometry, speed, turn_rate, scan)
        self.ticks += 1
        return moment

    @property
    def steps_per_turn(self):
        """How many steps the lidar takes to look all around."""
        return round(self.lidar.period_s / STEP_S)

    def _roll(self, motion, random):
        length, turn = np.hypot(*motion[:2]), abs(motion[2])
        spread = [0.004 * length**0.5, 0.002 * length**0.5, 0.004 * (length + turn) ** 0.5]
        slip = random.normal(size=3) * spread
        motion = motion * [self.scale, self.scale, 1.01] + [0, 0, self.veer * length] + slip
        self.odometry = compose(self.odometry, motion)

    def _scan(self, random):
        lidar = self.lidar
        x, y, heading = compose(self.pose, lidar.mount)
        ranges = cast(self.walls, np.array([x, y]), lidar.bearings() + heading, lidar.max_range)
        ranges = ranges + random.normal(size=lidar.beams) * lidar.range_noise
        # As REP 117 has it: not a number for a reading that failed, infinity where nothing came
        # back.
        ranges[random.random(lidar.beams) < lidar.dropout] = np.nan
        ranges[ranges > lidar.max_range] = np.inf
        ranges[ranges < lidar.min_range] = -np.inf
        return ranges
