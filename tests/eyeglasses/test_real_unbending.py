"""Two real frames, bent by curves that the package does not contain, without their bends again."""

import numpy as np
import pytest
from benchmarks.bent_frames import OwnBend, bend_frame, real_frame
from benchmarks.eyeglasses_modes import laid_on

from scan2albedo.eyeglasses import canonicalize

pytestmark = pytest.mark.slow
BEND = OwnBend(left_spread_mm=6, right_spread_mm=-6, twist_deg=4, drop_mm=3)


# The brow bar of the sunglasses runs along their rims: its handle reaches into them.
@pytest.mark.parametrize(
    ("file", "form_mm", "left"), [("frame_giraut.stl", 0.15, 0.6), ("sunglasses_khronos.glb", 0.7, 0.35)]
)
def test_real_rims_keep_their_form_and_fronts_lose_their_bend(shared_data, file, form_mm, left):
    frame = real_frame(shared_data, file)
    bent = bend_frame(frame, BEND)
    found = canonicalize([(bent, frame.faces)], [frame.key_points(bent)], spacing=2.0).frames[0]
    for rim in frame.rims:
        assert np.linalg.norm(laid_on(found.vertices[rim], bent[rim]) - bent[rim], axis=1).max() < form_mm
    front = frame.vertices[:, 2] > frame.vertices[:, 2].max() - 25
    before, after = (
        np.sqrt(((laid_on(v[front], frame.vertices[front]) - frame.vertices[front]) ** 2).sum(1).mean())
        for v in (bent, found.vertices)
    )
    assert before > 0.8
    assert after < left * before
