"""Simultaneous localisation and mapping by a Rao-Blackwellised particle filter on grid maps.

The family of FastSLAM and Gmapping (Grisetti, Stachniss, Burgard, 2007): each particle is a guess
at the robot's way with the map that follows from it. Odometry proposes a step, matching the scan
with the particle's own map improves it, a Gaussian around the match is what the new pose is drawn
from, and particles are resampled when few of them carry the weight.
"""

from dataclasses import dataclass

import numpy as np

from corridor_mapping.geometry import between, compose
from corridor_mapping.grid_maps import GridMaps

# The odometry's errors: standard deviations per metre and per radian, and a minimum for each step.
# Metres for each metre, metres for each radian, metres.
FORWARD_ERROR = np.array([0.10, 0.02, 0.01])
SIDE_ERROR = np.array([0.05, 0.02, 0.01])
# Radians for each metre, for each radian, radians.
HEADING_ERROR = np.array([0.03, 0.05, 0.004])
# The echoes of a scan are not independent: this many count as one.
ECHOES_PER_WITNESS = 3.0
# The search for the best match: step lengths in metres, each paired with one in radians, and moves
# tried with each.
SEARCH_STEPS = [(0.06, 0.02), (0.03, 0.01), (0.015, 0.005), (0.008, 0.0025)]
MOVES_PER_STEP = 4
# The Gaussian around the match is measured at this many places, spread like this.
PLACES = 24
SPREAD = np.array([0.015, 0.01, 0.003])


@dataclass(frozen=True)
class Settings:
    """What can be set from outside."""

    particles: int = 20
    resolution: float = 0.05
    max_range: float = 8.0
    seed: int = 1
    step_m: float = 0.2
    step_rad: float = 0.2


class ParticleFilter:
    """Hears odometry poses with scans, keeps poses and maps."""

    def __init__(self, settings, bearings, mount):
        self.settings = settings
        self.random = np.random.default_rng(settings.seed)
        self.bearings = np.asarray(bearings)
        self.mount = np.asarray(mount, float)
        self.poses = np.zeros((settings.particles, 3))
        self.log_weights = np.zeros(settings.particles)
        self.maps = GridMaps(settings.particles, settings.resolution)
        self.odometry = None
        self.scans_used = 0

    @property
    def best(self):
        """The particle that explains everything best."""
        return int(np.argmax(self.log_weights))

    @property
    def pose(self):
        """Where the best particle was at the last scan used."""
        return self.poses[self.best]

    def wants(self, odometry):
        """Whether the robot moved enough since the last scan used."""
        if self.odometry is None:
            return True
        step = between(self.odometry, odometry)
        return np.hypot(*step[:2]) >= self.settings.step_m or abs(step[2]) >= self.settings.step_rad

    def update(self, odometry, ranges):
        """Moves all particles and draws the scan into their maps."""
        bearings, ranges = self.echoes(ranges)
        if self.odometry is None:
            self.poses[:] = odometry
        else:
            self._move(between(self.odometry, odometry), bearings, ranges)
            self._resample()
        self.odometry = np.array(odometry)
        self.maps.integrate(compose(self.poses, self.mount), bearings, ranges)
        self.scans_used += 1

    def echoes(self, ranges):
        """The beams that say something: one without an echo may have met glass as well as open
        space."""
        ranges = np.asarray(ranges, float)
        heard = np.isfinite(ranges) & (ranges > 0) & (ranges <= self.settings.max_range)
        return self.bearings[heard], ranges[heard]

    def _move(self, step, bearings, ranges):
        points = np.stack([np.cos(bearings), np.sin(bearings)], axis=-1) * ranges[:, None]
        motion = np.array([np.hypot(*step[:2]), abs(step[2]), 1.0])
        error = np.array([FORWARD_ERROR @ motion, SIDE_ERROR @ motion, HEADING_ERROR @ motion])
        guesses = compose(self.poses, step)

        def target(offsets):
            """Log-likelihood of the scan and of the odometry, for offsets (particle, candidate, 3)
            from the guesses."""
            lasers = compose(compose(guesses[:, None], offsets), self.mount)
            likelihood = self.maps.match(lasers, points) / ECHOES_PER_WITNESS
            return likelihood - 0.5 * np.square(offsets / error).sum(axis=-1)

        summit = self._climb(target)
        places = summit[:, None] + self.random.normal(size=(PLACES, 3)) * SPREAD
        places[:, 0] = summit
        log_target = target(places)
        peak = log_target.max(axis=1, keepdims=True)
        shares = np.exp(log_target - peak)
        total = shares.sum(axis=1)
        mean = np.einsum("pk,pki->pi", shares, places) / total[:, None]
        away = places - mean[:, None]
        covariance = np.einsum("pk,pki,pkj->pij", shares, away, away) / total[:, None, None]
        covariance = covariance + np.eye(3) * 1e-8
        noise = np.linalg.cholesky(covariance) @ self.random.normal(size=(len(mean), 3, 1))
        self.poses = compose(guesses, mean + noise[..., 0])
        self.log_weights += peak[:, 0] + np.log(total / PLACES)

    def _climb(self, target):
        """Each particle's best offset, by steps that get smaller."""
        count = self.settings.particles
        summit = np.zeros((count, 3))
        everyone = np.arange(count)
        for metres, radians in SEARCH_STEPS:
            steps = np.concatenate([np.zeros((1, 3)), np.diag([metres, metres, radians])])
            steps = np.concatenate([steps, -steps[1:]])
            for _ in range(MOVES_PER_STEP):
                candidates = summit[:, None] + steps
                chosen = target(candidates).argmax(axis=1)
                if not chosen.any():
                    break
                summit = candidates[everyone, chosen]
        return summit

    def _resample(self):
        weights = np.exp(self.log_weights - self.log_weights.max())
        weights /= weights.sum()
        if 1 / np.square(weights).sum() >= self.settings.particles / 2:
            return
        chosen = systematic(weights, self.random.random())
        self.poses = self.poses[chosen]
        self.maps.select(chosen)
        self.log_weights[:] = 0


def systematic(weights, start):
    """Indices drawn in proportion to the weights, with one random number from [0, 1) for all of
    them."""
    count = len(weights)
    ticks = (np.arange(count) + start) / count
    return np.minimum(np.searchsorted(np.cumsum(weights), ticks, side="right"), count - 1)
