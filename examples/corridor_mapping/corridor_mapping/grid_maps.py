"""Occupancy grids, one for each particle, as arrays whose first axis is the particle.

Each has two layers: the log-odds of being occupied, which becomes the map, and the log-likelihood
of seeing an echo at a place, which scans are matched with: a likelihood field, in which a cell has
the likelihood of the nearest echo that showed a new wall. It forgets none: it is for buildings, not
for crowds. Maps grow to hold what was seen, up to a limit.
"""

import numpy as np

# The log odds that one scan adds to an occupied or a free cell, and their bound.
OCCUPIED_GAIN, FREE_GAIN, SURE = 0.9, 0.4, 6.0
# The likelihood field: the distance of echoes from their wall, as a standard deviation in cells;
# the log weight of an echo far from any wall, which is finite, because people walk by and walls are
# seen for the first time; the distance in cells from which that weight applies; and the maximum
# weight of an echo at a wall that the field does not have yet.
FIELD_SIGMA = 0.8
NO_WALL = -4.0
FIELD_REACH = FIELD_SIGMA * (-2 * NO_WALL) ** 0.5
NEW_WALL = -0.7
# All maps of a filter together, in cells.
MAX_CELLS = 24_000_000
GROWTH_M = 2.0
# Rays are sampled this many times per cell.
SAMPLES_PER_CELL = 1.4


class MapTooLarge(Exception):
    """The map would exceed its limit."""


class GridMaps:
    """The maps of all particles, on one common raster."""

    def __init__(self, particles, resolution, max_cells=MAX_CELLS):
        self.particles = particles
        self.resolution = resolution
        self.max_cells = max_cells
        # The lower left cell's column and row, counted from the frame's origin.
        self.corner = np.zeros(2, int)
        self.log_odds = np.zeros((particles, 0, 0), np.float32)
        self.field = np.zeros((particles, 0, 0), np.float32)
        reach = int(np.ceil(FIELD_REACH))
        square = np.meshgrid(*[np.arange(-reach, reach + 1)] * 2)
        self.stamp = np.stack(square, axis=-1).reshape(-1, 2)

    @property
    def origin(self):
        """x and y of the lower left corner."""
        return self.corner * self.resolution

    def probability(self, particle):
        """How probably each cell of a particle's map is occupied, and whether it is known."""
        log_odds = self.log_odds[particle]
        return 1 / (1 + np.exp(-log_odds)), log_odds != 0

    def select(self, chosen):
        """Keeps the maps of the chosen particles, in their order, some several times."""
        self.log_odds = self.log_odds[chosen]
        self.field = self.field[chosen]

    def integrate(self, lasers, bearings, ranges):
        """Draws a scan into all maps, each as seen from its own laser pose (particle, 3)."""
        rays = np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)
        points = rays * ranges[:, None]
        echoes = self._placed(lasers, points)
        self._grow(np.concatenate([echoes.reshape(-1, 2), lasers[:, :2]]))
        # Samples along each ray, ending one cell before its echo.
        counts = np.maximum((ranges / self.resolution - 1) * SAMPLES_PER_CELL, 0).astype(int)
        beam = np.repeat(np.arange(len(ranges)), counts)
        sample = np.arange(len(beam)) - np.repeat(np.cumsum(counts) - counts, counts)
        along = sample * (self.resolution / SAMPLES_PER_CELL)
        free = self._flat(self._cells(self._placed(lasers, rays[beam] * along[:, None])))
        occupied = self._flat(self._cells(echoes))
        # A cell counts once for each scan, and an echo outweighs the rays that graze it.
        change = np.zeros(self.log_odds.size, np.float32)
        change[free] = -FREE_GAIN
        change[occupied] = OCCUPIED_GAIN
        self.log_odds += change.reshape(self.log_odds.shape)
        np.clip(self.log_odds, -SURE, SURE, out=self.log_odds)
        self._stamp_field(lasers, points, echoes)

    def match(self, lasers, points):
        """How well a scan's echoes fit, as a log-likelihood.

        `lasers` are candidate poses (particle, candidate, 3), `points` the echoes as the laser sees
        them (echo, 2).
        """
        return self._likelihoods(lasers, points).sum(axis=-1)

    def _likelihoods(self, lasers, points):
        """The field at each echo (particle, candidate, echo), between the centres of the four cells
        around it."""
        placed = self._placed(lasers, points) / np.float32(self.resolution)
        placed = placed - (self.corner + 0.5).astype(np.float32)
        height, width = self.field.shape[1:]
        column, row = placed[..., 0], placed[..., 1]
        column = np.clip(column, 0, width - 1.001)
        row = np.clip(row, 0, height - 1.001)
        left, low = column.astype(np.int32), row.astype(np.int32)
        right, up = column - left, row - low
        first = np.arange(self.particles, dtype=np.int32).reshape(-1, 1, 1) * (height * width)
        base = first + low * width + left
        field = self.field.ravel()
        below = field[base] * (1 - right) + field[base + 1] * right
        above = field[base + width] * (1 - right) + field[base + width + 1] * right
        return below * (1 - up) + above * up

    def _stamp_field(self, lasers, points, echoes):
        """Adds the echoes that the field does not explain yet.

        Those it explains would only smear it: the first echoes of a wall are what later scans hold
        on to.
        """
        offsets = echoes / np.float32(self.resolution) - (self.corner + 0.5).astype(np.float32)
        particle, echo = np.nonzero(self._likelihoods(lasers[:, None], points)[:, 0] < NEW_WALL)
        offsets = offsets[particle, echo]
        cells = np.rint(offsets).astype(np.int32)[:, None] + self.stamp.astype(np.int32)
        squares = np.square(cells - offsets[:, None]).sum(axis=-1)
        likelihood = squares * np.float32(-0.5 / FIELD_SIGMA**2)
        height, width = self.field.shape[1:]
        touched = (particle[:, None] * height + cells[..., 1]) * width + cells[..., 0]
        np.maximum.at(self.field.reshape(-1), touched.ravel(), likelihood.ravel())

    def _placed(self, lasers, points):
        """Points as the lasers (..., 3) see them, in the maps' frame: (..., point, 2)."""
        lasers, points = lasers.astype(np.float32), points.astype(np.float32)
        cos, sin = np.cos(lasers[..., 2:]), np.sin(lasers[..., 2:])
        x = lasers[..., :1] + cos * points[:, 0] - sin * points[:, 1]
        y = lasers[..., 1:2] + sin * points[:, 0] + cos * points[:, 1]
        return np.stack([x, y], axis=-1)

    def _cells(self, places):
        cells = np.floor(places / np.float32(self.resolution)).astype(np.int32)
        return cells - self.corner.astype(np.int32)

    def _flat(self, cells):
        """Indices into a layer made flat, of cells (particle, cells..., 2)."""
        height, width = self.log_odds.shape[1:]
        first = np.arange(self.particles, dtype=np.int32) * (height * width)
        flat = cells[..., 1] * np.int32(width) + cells[..., 0]
        return (flat + first.reshape((-1,) + (1,) * (flat.ndim - 1))).ravel()

    def _grow(self, places):
        """Makes room for all places and what their echoes touch."""
        margin = (FIELD_REACH + 2) * self.resolution
        low = np.floor((places.min(axis=0) - margin) / self.resolution).astype(int)
        high = np.floor((places.max(axis=0) + margin) / self.resolution).astype(int) + 1
        size = np.array(self.log_odds.shape[:0:-1])
        if size.all() and (low >= self.corner).all() and (high <= self.corner + size).all():
            return
        chunk = int(np.ceil(GROWTH_M / self.resolution))
        if size.all():
            low, high = np.minimum(low, self.corner), np.maximum(high, self.corner + size)
        else:
            self.corner = low
        before = -(-(self.corner - low) // chunk) * chunk
        after = -(-(high - self.corner - size) // chunk) * chunk
        width, height = size + before + after
        if width * height * self.particles > self.max_cells:
            raise MapTooLarge(
                f"{self.particles} maps of {width} x {height} cells are more than {self.max_cells} "
                "cells together"
            )
        around = ((0, 0), (before[1], after[1]), (before[0], after[0]))
        self.log_odds = np.pad(self.log_odds, around)
        self.field = np.pad(self.field, around, constant_values=NO_WALL)
        self.corner = self.corner - before
