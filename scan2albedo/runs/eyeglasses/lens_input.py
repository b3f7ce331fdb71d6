"""What the command `glasses lenses` is given: files and options, checked, errors name the file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scan2albedo.core.arrays import FloatArray
from scan2albedo.errors import EyeglassesError
from scan2albedo.eyeglasses import Camera, LensMaterial, Surface, read_cameras
from scan2albedo.io.images import read_image_linear
from scan2albedo.io.input_hash import file_sha256, input_sha256
from scan2albedo.io.load_scan import load_scan
from scan2albedo.runs.eyeglasses.input import GlassesFrame, keypoints_beside, read_frame

if TYPE_CHECKING:
    from scan2albedo.core.raw_scan import RawScan


_FRAME_ALBEDO = (0.05, 0.05, 0.06)
_HEAD_ALBEDO = (0.5, 0.5, 0.5)
_SKIN_ROUGHNESS_RAD = 0.3
_SUN_TINT, _SUN_ALPHA = (0.1, 0.07, 0.03), 0.85
_TINT_ALPHA = 0.5
_GLASS_BETA = 0.04
"""What glass of index 1.5 mirrors at right angles."""


@dataclass(frozen=True)
class LensInput:
    """Frame, head, cameras and pictures as read."""

    frame: GlassesFrame
    head: RawScan
    head_file: Path
    cameras: tuple[Camera, ...]
    cameras_file: Path
    pictures: tuple[FloatArray, ...] | None
    """(H, W, 3) linear, one a camera."""
    picture_files: tuple[Path, ...]
    environment: FloatArray | None
    """(H, W, 3)"""
    environment_file: Path | None
    hashes: Mapping[Path, str]
    """SHA-256 of the files as read; of meshes with those they refer to."""

    @property
    def frame_surface(self) -> Surface:
        """The frame with its own colour, or dark."""
        return surface_of(self.frame.scan, _FRAME_ALBEDO)

    @property
    def head_surface(self) -> Surface:
        """The head with its texture or colours, or grey."""
        return surface_of(self.head, _HEAD_ALBEDO, _SKIN_ROUGHNESS_RAD)


def read_lens_input(
    frame: Path,
    head: Path,
    cameras: Path,
    *,
    keypoints: Path | None = None,
    views: Sequence[str] = (),
    pictures: Sequence[Path] = (),
    environment: Path | None = None,
    unit: str = "auto",
) -> LensInput:
    """Read the files of a rendering; the unit is that of both meshes, and "auto" decides for each.

    Key points are otherwise ``<frame stem>.keypoints.json`` or ``keypoints.json`` beside the frame. `views`
    name cameras, all when there are none; `pictures`, one a view, are named after their cameras or in the
    views' order. Raises EyeglassesError or ScanError, naming the file, when one cannot be read or does not
    fit the others.
    """
    chosen = _chosen(read_cameras(cameras), views, cameras)
    marks = keypoints if keypoints is not None else _keypoints_of(frame)
    files = _matched(pictures, chosen)
    others = (cameras, *files, environment)
    return LensInput(
        frame=read_frame(frame, marks, unit),
        head=load_scan(head, unit),
        head_file=head,
        cameras=chosen,
        cameras_file=cameras,
        pictures=tuple(_picture(f, c) for f, c in zip(files, chosen, strict=True)) if files else None,
        picture_files=files,
        environment=None if environment is None else np.asarray(read_image_linear(environment), np.float64),
        environment_file=environment,
        hashes={head: input_sha256(head)} | {path: file_sha256(path) for path in others if path is not None},
    )


def surface_of(scan: RawScan, albedo: tuple[float, float, float], roughness_rad: float = 0.0) -> Surface:
    """Return a scan as a surface with its texture, its vertex colours, or the albedo given."""
    if scan.uv is not None and scan.texture_linear is not None:
        return Surface(
            scan.vertices,
            scan.faces,
            uv=scan.uv,
            texture_linear=scan.texture_linear,
            roughness_rad=roughness_rad,
        )
    colors = albedo if scan.vertex_color_linear is None else scan.vertex_color_linear
    return Surface(scan.vertices, scan.faces, colors, roughness_rad=roughness_rad)


def material_pair(
    dioptres: str,
    *,
    tint: str | None,
    alpha: float | None,
    beta: float | None,
    sunglasses: bool,
    fresnel: bool,
) -> tuple[LensMaterial, LensMaterial]:
    """Return the left and the right lens of the command's options.

    Raises ValueError when a text is no number or holds too many or too few, EyeglassesError when one is out
    of range.
    """
    powers = _numbers("--dioptres", dioptres, (1, 2))
    color = (
        _numbers("--tint", tint, (3,)) if tint is not None else (_SUN_TINT if sunglasses else (0.0, 0.0, 0.0))
    )
    share = _SUN_ALPHA if sunglasses else (0.0 if tint is None else _TINT_ALPHA)
    mirrors = fresnel or sunglasses
    left, right = (
        LensMaterial(
            power,
            color,
            alpha=share if alpha is None else alpha,
            beta=(_GLASS_BETA if mirrors else 0.0) if beta is None else beta,
            fresnel=mirrors,
            tinting="filter" if sunglasses else "paint",
        )
        for power in (powers[0], powers[-1])
    )
    return left, right


def _numbers(name: str, text: str, counts: tuple[int, ...]) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"{name} takes numbers with commas between them, got {text!r}") from None
    if len(values) not in counts:
        wanted = " or ".join(str(c) for c in counts)
        raise ValueError(f"{name} takes {wanted} numbers, got {len(values)} in {text!r}")
    return values


def _keypoints_of(frame: Path) -> Path:
    own, shared = keypoints_beside(frame), frame.with_name("keypoints.json")
    return shared if shared.is_file() and not own.is_file() else own


def _chosen(cameras: tuple[Camera, ...], names: Sequence[str], file: Path) -> tuple[Camera, ...]:
    by_name = {camera.name: camera for camera in cameras}
    strange = [name for name in names if name not in by_name]
    if strange:
        raise EyeglassesError(f"cameras {file}: there is no view {strange[0]!r}, only {', '.join(by_name)}")
    return tuple(by_name[name] for name in dict.fromkeys(names)) or cameras


def _matched(pictures: Sequence[Path], cameras: tuple[Camera, ...]) -> tuple[Path, ...]:
    """Return a picture a camera, in the cameras' order."""
    if pictures and len(pictures) != len(cameras):
        names = ", ".join(camera.name for camera in cameras)
        raise EyeglassesError(
            f"picture {pictures[0]}: there are {len(pictures)} pictures for {len(cameras)} views ({names}); "
            "give one a view, and choose views by --view"
        )
    stems = {picture.stem: picture for picture in pictures}
    if all(camera.name in stems for camera in cameras):
        return tuple(stems[camera.name] for camera in cameras)
    return tuple(pictures)


def _picture(file: Path, camera: Camera) -> FloatArray:
    image = np.asarray(read_image_linear(file), np.float64)
    if image.shape[:2] != camera.shape:
        (height, width), (wanted_height, wanted_width) = image.shape[:2], camera.shape
        raise EyeglassesError(
            f"picture {file} is {width} x {height} pixels, the view {camera.name!r} {wanted_width} x "
            f"{wanted_height}; give the picture that this camera took"
        )
    return image
