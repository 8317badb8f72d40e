"""The parts of the filter, and what they come to together: the map against the true corridor."""

import unittest

import numpy as np

from corridor_mapping import score, world
from corridor_mapping.geometry import between, compose
from corridor_mapping.grid_maps import GridMaps, MapTooLarge
from corridor_mapping.map_file import FREE, OCCUPIED, UNKNOWN
from corridor_mapping.mapping_run import picture_of
from corridor_mapping.particle_filter import Settings, systematic
from corridor_mapping.rehearsal import rehearse
from corridor_mapping.simulation import Simulation, cast, true_drive

ROOM = np.array(
    [[[-1, -1], [2, -1]], [[2, -1], [2, 1]], [[2, 1], [-1, 1]], [[-1, 1], [-1, -1]]], float
)


class Geometry(unittest.TestCase):
    def test_a_step_leads_from_one_pose_to_the_other(self):
        begin, end = np.array([1.0, 2.0, 3.0]), np.array([-4.0, 0.5, -3.0])
        np.testing.assert_allclose(compose(begin, between(begin, end)), end, atol=1e-12)


class RayCasting(unittest.TestCase):
    def test_rays_end_at_the_nearest_wall(self):
        bearings = np.array([0, np.pi / 2, np.pi, np.pi / 4])
        np.testing.assert_allclose(cast(ROOM, np.zeros(2), bearings, 8.0), [2, 1, 1, 2**0.5])

    def test_rays_beyond_the_range_have_no_echo(self):
        self.assertEqual(cast(ROOM, np.zeros(2), np.array([0.0]), 1.9).tolist(), [np.inf])

    def test_the_robot_sees_walls_all_the_way(self):
        walls, bearings = world.walls(), np.linspace(-np.pi, np.pi, 90)
        for x, y, heading in true_drive()[::100, :3]:
            nearest = cast(walls, np.array([x, y]), bearings + heading, 8.0).min()
            self.assertGreater(nearest, 0.4)
            self.assertLess(nearest, 1.6)


class Drive(unittest.TestCase):
    def test_a_seed_decides_the_errors_and_standing_changes_nothing(self):
        def readings(seed, standing):
            simulation = Simulation(seed)
            for _ in range(standing):
                simulation.step(drives=False)
            moments = [simulation.step() for _ in range(40)]
            heard = [m for m in moments if m.ranges is not None]
            return np.concatenate([np.concatenate([m.odometry, m.ranges]) for m in heard])

        np.testing.assert_array_equal(readings(5, 0), readings(5, 7))
        self.assertFalse(np.array_equal(readings(5, 0), readings(6, 0), equal_nan=True))


class Grids(unittest.TestCase):
    def seen(self, lasers):
        bearings = np.linspace(-np.pi, np.pi, 720, endpoint=False)
        maps = GridMaps(len(lasers), 0.05)
        ranges = cast(ROOM, np.array([0.012, 0.012]), bearings, 8.0)
        # Once is not enough to be sure of free space.
        for _ in range(3):
            maps.integrate(np.array(lasers, float), bearings, ranges)
        return maps

    def test_scans_draw_walls_and_the_space_before_them(self):
        picture = picture_of(self.seen([[0.012, 0.012, 0]]), 0)
        places = np.array([[0.5, 0.5], [1.98, 0.02], [2.1, 0.02], [-0.98, 0.02]])
        rows_and_columns = np.floor((places - picture.origin) / 0.05 + 0.5).astype(int)[:, ::-1]
        values = picture.cells[tuple(rows_and_columns.T)].tolist()
        self.assertEqual(values, [FREE, OCCUPIED, UNKNOWN, OCCUPIED])

    def test_each_particle_has_its_own_map_on_the_common_raster(self):
        maps = self.seen([[0.012, 0.012, 0], [5.012, 0.012, 0]])
        first, second = maps.log_odds
        np.testing.assert_array_equal(first[:, :40], second[:, 100:140])
        maps.select(np.array([1, 1]))
        np.testing.assert_array_equal(maps.log_odds[0], second)

    def test_the_true_pose_matches_best(self):
        maps = self.seen([[0.012, 0.012, 0]])
        bearings = np.linspace(-np.pi, np.pi, 180, endpoint=False)
        points = np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)
        points *= cast(ROOM, np.array([0.012, 0.012]), bearings, 8.0)[:, None]
        offsets = np.array([[0, 0, 0], [0.05, 0, 0], [0, -0.05, 0], [0, 0, 0.05]])
        fits = maps.match(np.array([[0.012, 0.012, 0]])[:, None] + offsets, points)[0]
        self.assertEqual(fits.argmax(), 0)

    def test_a_map_that_would_not_fit_is_refused(self):
        maps = GridMaps(2, 0.05, max_cells=1000)
        with self.assertRaisesRegex(MapTooLarge, "2 maps of .* more than 1000 cells"):
            maps.integrate(np.zeros((2, 3)), np.zeros(1), np.array([8.0]))


class Resampling(unittest.TestCase):
    def test_particles_are_drawn_in_proportion(self):
        self.assertEqual(systematic(np.array([0.5, 0.0, 0.25, 0.25]), 0.5).tolist(), [0, 0, 2, 3])
        self.assertEqual(systematic(np.array([0.0, 0.0, 1.0]), 0.999).tolist(), [2, 2, 2])


class Score(unittest.TestCase):
    def test_the_map_is_as_good_as_promised_and_better_than_odometry(self):
        run, errors = rehearse(3, Settings(seed=3))
        figures = {
            "corridor": score.score(run.picture()),
            "odometry": score.score(picture_of(run.odometry_map, 0)),
        }
        print(f"\n{score.report(figures)}")
        self.assertGreaterEqual(figures["corridor"]["known"], 0.95)
        self.assertGreaterEqual(figures["corridor"]["walls_true"], 0.95)
        self.assertGreaterEqual(figures["corridor"]["walls_found"], 0.95)
        self.assertLess(figures["odometry"]["walls_true"], 0.5)
        self.assertLess(max(errors), 0.08)


if __name__ == "__main__":
    unittest.main()
