"""Maps as files: a PGM picture and a YAML file beside it, as `map_server` and `map_saver` have
them."""

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

OCCUPIED, UNKNOWN, FREE = 0, 205, 254
OCCUPIED_THRESHOLD, FREE_THRESHOLD = 0.65, 0.25


@dataclass
class MapPicture:
    """A map of three values. Row 0 of `cells` is the lowest y; in the file it is the last row."""

    cells: np.ndarray  # uint8, (row, column)
    resolution: float
    origin: np.ndarray  # x and y of the lower left corner

    @classmethod
    def of_probability(cls, probability, known, resolution, origin):
        cells = np.full(probability.shape, UNKNOWN, np.uint8)
        cells[known & (probability > OCCUPIED_THRESHOLD)] = OCCUPIED
        cells[known & (probability < FREE_THRESHOLD)] = FREE
        return cls(cells, resolution, np.asarray(origin))

    def centres(self):
        """x and y of all cells' centres: an array (row, column, coordinate)."""
        rows, columns = np.indices(self.cells.shape)
        return self.origin + (np.stack([columns, rows], axis=-1) + 0.5) * self.resolution

    def save(self, stem):
        """Writes `stem`.pgm and `stem`.yaml: each whole or not at all, the picture first."""
        stem = Path(stem)
        stem.parent.mkdir(parents=True, exist_ok=True)
        height, width = self.cells.shape
        header = f"P5\n# {self.resolution:g} m/cell\n{width} {height}\n255\n".encode()
        write_whole(stem.with_suffix(".pgm"), header + self.cells[::-1].tobytes())
        write_whole(stem.with_suffix(".yaml"), self._description(stem.name).encode())

    def _description(self, name):
        return (
            f"image: {name}.pgm\n"
            "mode: trinary\n"
            f"resolution: {self.resolution:g}\n"
            f"origin: [{self.origin[0]:g}, {self.origin[1]:g}, 0]\n"
            "negate: 0\n"
            f"occupied_thresh: {OCCUPIED_THRESHOLD}\n"
            f"free_thresh: {FREE_THRESHOLD}\n"
        )


def load(yaml_path):
    """Reads a map that `save` or `map_saver` wrote."""
    yaml_path = Path(yaml_path)
    text = yaml_path.read_text()
    entries = dict(re.findall(r"^(\w+):\s*(.*?)\s*$", text, re.MULTILINE))
    try:
        origin = [float(number) for number in entries["origin"].strip("[]").split(",")]
        resolution, image = float(entries["resolution"]), entries["image"]
    except (KeyError, ValueError) as error:
        raise ValueError(f"{yaml_path}: no map description: {error}") from error
    return MapPicture(_load_pgm(yaml_path.parent / image), resolution, np.array(origin[:2]))


def write_whole(path, content):
    """Writes a file that is never seen half written."""
    partial = path.with_name(path.name + ".part")
    partial.write_bytes(content)
    os.replace(partial, path)


def _load_pgm(path):
    content = path.read_bytes()
    header = re.match(rb"P5\s(?:#[^\n]*\n)*\s*(\d+)\s+(\d+)\s+255\s", content)
    if header is None:
        raise ValueError(f"{path}: not an 8-bit binary PGM file")
    width, height = int(header[1]), int(header[2])
    found = len(content) - header.end()
    if found != width * height:
        raise ValueError(f"{path}: {found} bytes of pixels, not {width} times {height}")
    return np.frombuffer(content, np.uint8, offset=header.end()).reshape(height, width)[::-1].copy()
