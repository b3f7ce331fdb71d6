"""A synthetic wearer's own frame, registered on the wearer."""

from helpers.wearers import rest_frame
from scan2albedo.eyeglasses import register_on_face


def register(worn, **changes):
    """Register a wearer's frame as it was before it was bent, with some arguments changed."""
    given = {
        "glasses": rest_frame(worn.sitter.seed),
        "keypoints_2d": worn.labels,
        "masks": worn.masks,
        "cameras": worn.cameras,
        "head": (worn.head_vertices, worn.head_faces),
    }
    return register_on_face(**{**given, **changes})
