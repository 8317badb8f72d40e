"""Poses in the plane: arrays whose last axis is x, y, heading."""

import numpy as np


def wrap(angle):
    """The same angle within [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def compose(pose, step):
    """Where `step`, made in the frame of `pose`, leads to."""
    pose, step = np.asarray(pose), np.asarray(step)
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    return np.stack(
        [
            pose[..., 0] + cos * step[..., 0] - sin * step[..., 1],
            pose[..., 1] + sin * step[..., 0] + cos * step[..., 1],
            wrap(pose[..., 2] + step[..., 2]),
        ],
        axis=-1,
    )


def inverse(pose):
    """The pose that `compose` with `pose` leads back from."""
    pose = np.asarray(pose)
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    return np.stack(
        [
            -cos * pose[..., 0] - sin * pose[..., 1],
            sin * pose[..., 0] - cos * pose[..., 1],
            wrap(-pose[..., 2]),
        ],
        axis=-1,
    )


def between(begin, end):
    """The step from one pose to another, in the frame of the first."""
    return compose(inverse(begin), end)
