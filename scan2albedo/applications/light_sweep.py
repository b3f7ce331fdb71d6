"""A light that moves around a face: frames, and an animation of them."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np

from scan2albedo.applications.relighting import RelightOptions, face_view, relight
from scan2albedo.core import PointLight
from scan2albedo.core.arrays import ArrayLike, ByteArray, GridShape, all_finite
from scan2albedo.core.lights import LAMP_RADIUS_DEG
from scan2albedo.io.atomic import write_bytes
from scan2albedo.io.images import write_png
from scan2albedo.io.records import OwnFileNames
from scan2albedo.io.result_records import RunRecord
from scan2albedo.io.run_folder import OwnFiles, RunFolder
from scan2albedo.rendering.pictures import Picture
from scan2albedo.rendering.scene_light import SceneLight
from scan2albedo.unlit.processed_face import ProcessedFace


class SweepRecord(RunRecord):
    """The content of a sweep's `sweep.json`."""

    files: OwnFileNames


FRAMES = OwnFiles("sweep.json", SweepRecord, ("frame_*.png",), command="scan2albedo relight --sweep")
"""Files of a sweep."""


def light_arc(
    count: int,
    *,
    first_rad: float = math.radians(-75),
    last_rad: float = math.radians(75),
    elevation_rad: float = math.radians(15),
    distance_mm: float = math.inf,
    intensity: float = 3.0,
    radius_deg: float = LAMP_RADIUS_DEG,
) -> list[PointLight]:
    """Return `count` places of a light that goes around the face from one azimuth to another.

    Raises `ValueError` without a place, or for angles that are not finite.

    Parameters
    ----------
    count : int
    first_rad, last_rad : float
        Azimuths of the first and the last place.
    elevation_rad, distance_mm, intensity, radius_deg : float
        As in `PointLight`.
    """
    if count < 1:
        raise ValueError(f"count must be 1 or more, got {count}")
    if not all_finite([first_rad, last_rad, elevation_rad]):
        raise ValueError(f"angles must be finite, got {first_rad}, {last_rad} and {elevation_rad}")
    return [
        PointLight(float(azimuth), elevation_rad, distance_mm, intensity, radius_deg=radius_deg)
        for azimuth in np.linspace(first_rad, last_rad, count)
    ]


def sweep(
    face: ProcessedFace,
    places: Sequence[PointLight],
    *,
    others: Sequence[PointLight] = (),
    ambient: float | None = None,
    camera: ArrayLike | None = None,
    shape: GridShape = (512, 512),
    samples: int = 2,
    options: RelightOptions = RelightOptions(),
) -> Iterator[Picture]:
    """Give a picture of the face for each of the light's places.

    Parameters
    ----------
    face : ProcessedFace
    places : sequence of PointLight
        One light a picture.
    others : sequence of PointLight
        Lights of every picture.
    ambient, options
        As in `relight`.
    camera, shape, samples
        As in `RelitFace.picture`.
    """
    relit = relight(face, (*others, *places), ambient=ambient, options=options)
    view = face_view(relit.face, camera, shape=shape, samples=samples)
    still = view.radiance(replace(relit.light, lamps=others))
    for place in places:
        yield view.picture(still + view.radiance(SceneLight([place])))


def frames_srgb(pictures: Sequence[Picture], exposure: float | None = None) -> list[ByteArray]:
    """Return (H, W, 3) sRGB bytes of pictures at one exposure: the brightest one's when None.

    ValueError without `pictures`, or for an `exposure` that is not finite and above 0.
    """
    if not pictures:
        raise ValueError("an animation needs a frame at least")
    factor = min(picture.auto_exposure() for picture in pictures) if exposure is None else exposure
    return [picture.srgb(factor) for picture in pictures]


def write_frames(folder: str | Path, frames: Sequence[ByteArray]) -> list[Path]:
    """Return the files of frames (H, W, 3) uint8, written as ``frame_000.png`` and so on into a folder.

    All or none, with ``sweep.json``. Frames of an earlier sweep are removed. OutputError when the folder
    cannot be written, or holds a file under one of these names that no sweep wrote. A film:
    ``ffmpeg -framerate 12 -i frame_%03d.png -pix_fmt yuv420p sweep.mp4``.
    """
    names = [f"frame_{k:03d}.png" for k in range(len(frames))]
    with RunFolder(folder, FRAMES).publishing() as staging:
        for name, frame in zip(names, frames, strict=True):
            write_png(staging.folder / name, frame)
        staging.write_record()
    return [Path(folder) / name for name in names]


def write_gif(path: str | Path, frames: Sequence[ByteArray], *, seconds_per_frame: float = 0.08) -> None:
    """Write frames (H, W, 3) uint8 as an animated GIF that plays forward and back for ever, atomically.

    Raises `OutputError` when the folder cannot be written; `ValueError` without frames, for frames of
    different sizes, or a time that is not above 0.

    Parameters
    ----------
    path, frames, seconds_per_frame : str or Path, sequence of (H, W, 3) uint8, float
    """
    from PIL import Image

    shapes = {np.shape(frame) for frame in frames}
    if len(shapes) != 1 or not 0 < seconds_per_frame < math.inf:
        raise ValueError(
            f"{len(frames)} frames have shapes {sorted(shapes)} and {seconds_per_frame} seconds each: an "
            "animation needs a frame at least, one shape and a time above 0"
        )
    first, *others = (Image.fromarray(frame).quantize(256) for frame in (*frames, *frames[-2:0:-1]))
    data, duration = BytesIO(), round(1000 * seconds_per_frame)
    first.save(data, format="GIF", save_all=True, append_images=others, duration=duration, loop=0)
    write_bytes(path, data.getvalue())
