"""How good a map is, by the true corridor: a command that prints and saves the figures.

The map's frame is where the robot starts, and so is the world's: nothing is aligned or fitted.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from corridor_mapping import map_file, world
from corridor_mapping.geometry import compose
from corridor_mapping.simulation import STEP_S, cast, true_drive

# Rays that find the visible cells: this many for each beam, from every tenth turn of the lidar.
RAYS_PER_BEAM = 4
TURNS_APART = 10


def score(picture):
    """Shares from 0 to 1.

    known: of the cells that the lidar could see, those the map knows. walls_true: of the map's wall
    cells, those within one cell of a true wall. walls_found: of the wall cells that the lidar could
    see, those with one of the map's within one cell.
    """
    shape = picture.cells.shape
    seen, seen_walls = visible(picture)
    known = picture.cells != map_file.UNKNOWN
    occupied = picture.cells == map_file.OCCUPIED
    near_true = widened(true_walls(picture))
    seen_outside = seen[~inside(seen, shape)]
    index = tuple(seen[inside(seen, shape)].T)
    walls_inside = seen_walls[inside(seen_walls, shape)]
    return {
        "known": known[index].sum() / max(len(index[0]) + len(seen_outside), 1),
        "walls_true": near_true[occupied].sum() / max(occupied.sum(), 1),
        "walls_found": widened(occupied)[tuple(walls_inside.T)].sum() / max(len(seen_walls), 1),
    }


def visible(picture):
    """Rows and columns of the cells that a lidar without noise could see on the way, and of those
    with an echo."""
    lidar, walls = world.LIDAR, world.walls()
    bearings = np.linspace(-np.pi, np.pi, lidar.beams * RAYS_PER_BEAM, endpoint=False)
    along = np.arange(0, lidar.max_range, picture.resolution / 2)
    # Everything that a wall can be seen on, whether or not the map reaches so far.
    low = np.floor((walls.min(axis=(0, 1)) - picture.origin) / picture.resolution).astype(int) - 1
    high = np.floor((walls.max(axis=(0, 1)) - picture.origin) / picture.resolution).astype(int) + 2
    seen, echoes = np.zeros((2, *(high - low)[::-1]), bool)

    def mark(cells, points):
        places = np.floor((points - picture.origin) / picture.resolution).astype(int)
        columns, rows = (places - low).T
        cells[rows, columns] = True

    turns = true_drive()[:: TURNS_APART * round(lidar.period_s / STEP_S), :3]
    for x, y, heading in compose(turns, lidar.mount):
        place = np.array([x, y])
        ranges = cast(walls, place, bearings + heading, lidar.max_range)
        rays = np.stack([np.cos(bearings + heading), np.sin(bearings + heading)], axis=-1)
        mark(seen, (place + rays[:, None] * along[:, None])[along < ranges[:, None]])
        heard = np.isfinite(ranges)
        mark(echoes, place + rays[heard] * ranges[heard, None])
    seen |= echoes
    return np.argwhere(seen) + low[::-1], np.argwhere(echoes) + low[::-1]


def inside(cells, shape):
    return ((cells >= 0) & (cells < shape)).all(axis=-1)


def true_walls(picture):
    """The cells that a true wall passes through."""
    cells = np.zeros(picture.cells.shape, bool)
    for begin, end in world.walls():
        count = int(np.hypot(*(end - begin)) / picture.resolution * 10) + 2
        points = begin + np.linspace(0, 1, count)[:, None] * (end - begin)
        found = np.floor((points - picture.origin) / picture.resolution).astype(int)[:, ::-1]
        cells[tuple(found[inside(found, cells.shape)].T)] = True
    return cells


def widened(cells):
    """The cells and their eight neighbours."""
    padded = np.pad(cells, 1)
    height, width = cells.shape
    shifted = [padded[r : r + height, c : c + width] for r in range(3) for c in range(3)]
    return np.any(shifted, axis=0)


def report(scores):
    """The figures as lines for people."""
    lines = [f"{'':10} {'cells known':>12} {'walls true':>12} {'walls found':>12}"]
    for name, figures in scores.items():
        shares = (figures[key] for key in ("known", "walls_true", "walls_found"))
        lines.append(f"{name:10} " + " ".join(f"{share:12.1%}" for share in shares))
    return "\n".join(lines)


def score_files(directory):
    """Scores both maps of a run and writes score.json beside them."""
    directory = Path(directory)
    names = ("corridor", "odometry")
    scores = {name: score(map_file.load(directory / f"{name}.yaml")) for name in names}
    map_file.write_whole(directory / "score.json", (json.dumps(scores, indent=2) + "\n").encode())
    return scores


def main():
    description = "Compares the maps of a run with the true corridor."
    parser = argparse.ArgumentParser(description=description)
    place = "where corridor.yaml and odometry.yaml are"
    parser.add_argument("directory", nargs="?", default="maps", help=place)
    try:
        print(report(score_files(parser.parse_args().directory)))
    except (OSError, ValueError) as error:
        sys.exit(f"score: {error}")


if __name__ == "__main__":
    main()
