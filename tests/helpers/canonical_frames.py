"""Frames with their weights, given to `canonicalize`."""

from dataclasses import dataclass, replace
from typing import Any

from helpers.eyeglasses import posed
from scan2albedo.eyeglasses import canonicalize


@dataclass(frozen=True)
class GivenFrame:
    vertices: Any
    faces: Any
    keypoints: Any
    weights: Any

    @classmethod
    def of(cls, glasses, weights):
        """Return a synthetic frame with weights."""
        return cls(glasses.vertices, glasses.faces, glasses.keypoints, weights)

    def scaled(self, factor):
        return replace(self, vertices=factor * self.vertices, keypoints=factor * self.keypoints)

    def posed(self, seed):
        """Return it turned and shifted at random."""
        return replace(self, vertices=posed(self.vertices, seed), keypoints=posed(self.keypoints, seed))


def canonical(frames, **more):
    """Return the canonical set of frames, by their own weights unless others are given."""
    given = {"weights": [frame.weights for frame in frames], **more}
    return canonicalize(frames, [frame.keypoints for frame in frames], **given)
