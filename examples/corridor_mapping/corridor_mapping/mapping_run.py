"""Both maps of one run: the particle filter's, and the one that raw odometry gives, drawn from the
same scans."""

import numpy as np

from corridor_mapping.geometry import compose
from corridor_mapping.grid_maps import GridMaps
from corridor_mapping.map_file import MapPicture
from corridor_mapping.particle_filter import ParticleFilter


class MappingRun:
    """Takes scans with the odometry pose of their time."""

    def __init__(self, settings, bearings, mount):
        self.filter = ParticleFilter(settings, bearings, mount)
        self.odometry_map = GridMaps(1, settings.resolution)

    def hear(self, odometry, ranges):
        """Uses the scan if the robot moved enough; says whether it did."""
        if not self.filter.wants(odometry):
            return False
        self.filter.update(odometry, ranges)
        bearings, ranges = self.filter.echoes(ranges)
        laser = compose(np.array([odometry]), self.filter.mount)
        self.odometry_map.integrate(laser, bearings, ranges)
        return True

    def picture(self):
        """The best particle's map."""
        return picture_of(self.filter.maps, self.filter.best)

    def save(self, directory):
        """Writes corridor.pgm and odometry.pgm with their YAML files."""
        self.picture().save(directory / "corridor")
        picture_of(self.odometry_map, 0).save(directory / "odometry")


def picture_of(maps, particle):
    return MapPicture.of_probability(*maps.probability(particle), maps.resolution, maps.origin)
