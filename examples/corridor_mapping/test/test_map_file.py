"""The files that `map_server` reads."""

import tempfile
import unittest
from pathlib import Path

import numpy as np

from corridor_mapping.map_file import FREE, OCCUPIED, UNKNOWN, MapPicture, load


class MapFile(unittest.TestCase):
    def setUp(self):
        directory = tempfile.TemporaryDirectory()
        self.addCleanup(directory.cleanup)
        self.directory = Path(directory.name)

    def test_probabilities_become_three_values(self):
        probability, known = np.array([[0.9, 0.1, 0.5, 0.9]]), np.array([[True, True, True, False]])
        picture = MapPicture.of_probability(probability, known, 0.05, [0, 0])
        self.assertEqual(picture.cells.tolist(), [[OCCUPIED, FREE, UNKNOWN, UNKNOWN]])

    def test_the_files_are_as_map_server_has_them(self):
        # The lower row first; pictures begin with the upper one.
        cells = np.array([[0, 205, 254], [254, 254, 0]], np.uint8)
        MapPicture(cells, 0.05, np.array([-1.5, 2.0])).save(self.directory / "maps" / "room")
        pgm = (self.directory / "maps" / "room.pgm").read_bytes()
        self.assertEqual(pgm, b"P5\n# 0.05 m/cell\n3 2\n255\n\xfe\xfe\x00\x00\xcd\xfe")
        self.assertEqual(
            (self.directory / "maps" / "room.yaml").read_text(),
            "image: room.pgm\nmode: trinary\nresolution: 0.05\norigin: [-1.5, 2, 0]\nnegate: 0\n"
            "occupied_thresh: 0.65\nfree_thresh: 0.25\n",
        )
        names = sorted(path.name for path in (self.directory / "maps").iterdir())
        self.assertEqual(names, ["room.pgm", "room.yaml"])
        again = load(self.directory / "maps" / "room.yaml")
        np.testing.assert_array_equal(again.cells, cells)
        self.assertEqual((again.resolution, again.origin.tolist()), (0.05, [-1.5, 2.0]))

    def test_broken_files_are_refused_by_name(self):
        yaml = "image: a.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n"
        (self.directory / "a.yaml").write_text(yaml)
        (self.directory / "a.pgm").write_bytes(b"P5\n3 2\n255\n\0\0\0\0\0")
        with self.assertRaisesRegex(ValueError, "a.pgm: 5 bytes of pixels, not 3 times 2"):
            load(self.directory / "a.yaml")
        (self.directory / "b.yaml").write_text("image: a.pgm\n")
        with self.assertRaisesRegex(ValueError, "b.yaml: no map description"):
            load(self.directory / "b.yaml")


if __name__ == "__main__":
    unittest.main()
