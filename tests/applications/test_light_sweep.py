"""A light that goes around: frames differ, one exposure, PNG and GIF."""

import math

import numpy as np
import pytest
from helpers.records import files_in
from numpy.testing import assert_array_equal
from PIL import Image

from scan2albedo.applications import frames_srgb, light_arc, sweep, write_frames, write_gif
from scan2albedo.errors import OutputError


@pytest.fixture(scope="module")
def pictures(person):
    return list(sweep(person(0), light_arc(3), shape=(48, 48), samples=1))


def test_the_bright_side_moves_with_the_light(pictures):
    left, right = ([p.linear[:, half].mean() for p in pictures] for half in (slice(0, 24), slice(24, None)))
    assert left[0] > right[0]
    assert left[2] < right[2]


def test_frames_share_an_exposure(pictures):
    factor = min(p.auto_exposure() for p in pictures)
    assert_array_equal(frames_srgb(pictures), [picture.srgb(factor) for picture in pictures])


def test_files(pictures, tmp_path):
    frames = frames_srgb(pictures)
    files = write_frames(tmp_path / "frames", frames)
    assert [f.name for f in files] == ["frame_000.png", "frame_001.png", "frame_002.png"]
    assert_array_equal(np.asarray(Image.open(files[1])), frames[1])
    write_gif(tmp_path / "sweep.gif", frames)
    with Image.open(tmp_path / "sweep.gif") as gif:
        assert gif.n_frames == 4
        assert gif.info["loop"] == 0
    (tmp_path / "frames" / "frame_notes.txt").touch()
    write_frames(tmp_path / "frames", frames[:2])
    names = {"frame_000.png", "frame_001.png", "frame_notes.txt", "sweep.json"}
    assert files_in(tmp_path / "frames") == names
    (tmp_path / "frames" / "frame_007.png").touch()
    with pytest.raises(OutputError, match=r"holds frame_007\.png, which no run of scan2albedo relight"):
        write_frames(tmp_path / "frames", frames[:2])
    assert files_in(tmp_path / "frames") == {"frame_007.png", *names}


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda file, frames: write_gif(file.parent / "none" / "sweep.gif", frames), "cannot write"),
        (lambda file, frames: write_gif(file, []), "a frame at least"),
        (lambda file, frames: write_gif(file, [frames[0], frames[1][:5]]), "one shape"),
        (lambda file, frames: write_gif(file, frames, seconds_per_frame=math.nan), "above 0"),
        (lambda file, frames: frames_srgb([]), "a frame at least"),
        (lambda file, frames: light_arc(0), "count"),
        (lambda file, frames: light_arc(3, last_rad=math.nan), "finite"),
    ],
)
def test_what_no_sweep_can_be_made_of_is_refused(pictures, tmp_path, call, words):
    with pytest.raises((OutputError, ValueError), match=words):
        call(tmp_path / "sweep.gif", frames_srgb(pictures))
    with pytest.raises(ValueError, match="exposure is nan"):
        frames_srgb(pictures, math.nan)


def test_places_of_the_light():
    arc = light_arc(5, first_rad=-1.0, last_rad=1.0, elevation_rad=0.2)
    assert [light.azimuth_rad for light in arc] == [-1.0, -0.5, 0.0, 0.5, 1.0]
    assert {light.elevation_rad for light in arc} == {0.2}
    assert math.isinf(arc[0].distance_mm)
    assert len(light_arc(1)) == 1
