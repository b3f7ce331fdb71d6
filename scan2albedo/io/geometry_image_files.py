"""Geometry images as NumPy archives (complete, exact) and as multi-layer EXR (for other programs)."""

from pathlib import Path

import numpy as np

from scan2albedo.core import GeometryImage
from scan2albedo.core.arrays import Float32Array, NDArray
from scan2albedo.core.geometry_image import ARRAYS
from scan2albedo.errors import GeometryImageError, ScanError, errors_of
from scan2albedo.io.images import read_exr_channels, read_image_linear, write_exr_channels
from scan2albedo.io.npz import read_npz, write_npz

FORMAT_VERSION = 1

_NAME_IN_FILE = {name: name for name in ARRAYS if name != "camera"} | {"position": "position_mm"}
_EXR_CHANNELS = {"position": "XYZ", "normal": "XYZ", "texture_linear": "RGB", "face_chart": "YX"}
_KINDS = {"format_version": "iu", "occluder_faces": "iu"}
_KINDS |= {name: {"b": "b", "u": "iu"}.get(np.dtype(kind).kind, "fiu") for name, (kind, _) in ARRAYS.items()}
"""Letters of the kinds of dtype that arrays of an archive have; real numbers for all others."""


def write_geometry_image(path: str | Path, image: GeometryImage) -> None:
    """Write a geometry image as an ``.npz`` without loss, atomically.

    Arrays: ``position_mm``, ``normal``, ``mask`` and, where the image has them, ``region``,
    ``texture_linear``, ``texture_valid``, ``specular_scale``, ``inpaint``, ``skin``, ``labels``,
    ``face_chart``, ``filled``, ``on_face``, ``camera`` and ``camera_positions_mm``,
    ``occluder_vertices_mm`` and ``occluder_faces``;
    ``texture_log_odds``; ``format_version`` is 1. Raises OutputError when the folder cannot be written.
    """
    arrays: dict[str, NDArray] = {"format_version": np.array(FORMAT_VERSION)}
    arrays["texture_log_odds"] = np.array(image.texture_log_odds)
    for field, stored in _NAME_IN_FILE.items():
        if getattr(image, field) is not None:
            arrays[stored] = getattr(image, field)
    if image.occluder is not None:
        arrays["occluder_vertices_mm"], arrays["occluder_faces"] = image.occluder
    if image.camera is not None and image.camera_positions is not None:
        arrays["camera"], arrays["camera_positions_mm"] = image.camera, image.camera_positions
    # All but the empty texels of these hardly shrinks: a sixth of the file for two thirds of the time.
    write_npz(path, arrays, what="geometry image", compression=1, plain=("position_mm", "normal"))


def write_geometry_image_exr(path: str | Path, image: GeometryImage) -> None:
    """Write a geometry image as a 32-bit float EXR with one layer a field, atomically.

    Channels: ``position_mm.X`` ``.Y`` ``.Z``, ``normal.X`` ``.Y`` ``.Z``, ``texture_linear.R`` ``.G`` ``.B``,
    and ``mask.Y``, ``region.Y``, ``texture_valid.Y``, ``specular_scale.Y``, ``inpaint.Y``, ``skin.Y``,
    ``labels.Y``, ``face_chart.Y`` ``.X`` (row, column), ``filled.Y``, ``on_face.Y``. The occluder and the
    cameras do not fit into an image and are left out. Raises OutputError when the folder cannot be written.
    """
    channels: dict[str, Float32Array] = {}
    for field, stored in _NAME_IN_FILE.items():
        value = getattr(image, field)
        if value is not None:
            planes = value[..., None] if value.ndim == 2 else value
            for i, letter in enumerate(_EXR_CHANNELS.get(field, "Y")):
                channels[f"{stored}.{letter}"] = planes[..., i].astype(np.float32)
    write_exr_channels(path, channels)


def read_geometry_image(path: str | Path) -> GeometryImage:
    """Return the geometry image that `write_geometry_image` or `write_geometry_image_exr` wrote.

    Raises GeometryImageError, naming the file `path`, when it is missing, damaged, of another extension than
    .npz and .exr, or lacks position, normal or mask.
    """
    file, arrays = Path(path), dict[str, NDArray]()
    if file.suffix.lower() == ".npz":
        arrays = read_npz(file, what="geometry image", advice="write it again", error=GeometryImageError)
        for name, array in arrays.items():
            if array.dtype.kind not in _KINDS.get(name, "fiu"):
                raise GeometryImageError(f"{file}: {name} holds {array.dtype}; write it again")
        version = arrays.pop("format_version", np.array(FORMAT_VERSION))
        if version.ndim or version > FORMAT_VERSION:
            raise GeometryImageError(
                f"{file.name}: format version {version} is newer than {FORMAT_VERSION}; update scan2albedo"
            )
    elif file.suffix.lower() == ".exr":
        with errors_of(str(file), GeometryImageError, ScanError):
            channels = read_exr_channels(file)
        for field, stored in _NAME_IN_FILE.items():
            letters = _EXR_CHANNELS.get(field, "Y")
            planes = [channels[f"{stored}.{c}"] for c in letters if f"{stored}.{c}" in channels]
            if len(planes) == len(letters):
                arrays[stored] = np.stack(planes, axis=-1) if len(letters) > 1 else planes[0]
    else:
        kind = file.suffix or "without extension"
        raise GeometryImageError(f"{file.name}: geometry images are .npz or .exr, not {kind}")
    missing = [name for name in ("position_mm", "normal", "mask") if name not in arrays]
    if missing:
        raise GeometryImageError(
            f"{file.name}: holds no {', '.join(missing)}; it is not a geometry image of scan2albedo "
            f"(found: {', '.join(sorted(arrays)) or 'nothing'})"
        )
    fields = {field: arrays.get(stored) for field, stored in _NAME_IN_FILE.items()}
    occluder = None
    if "occluder_vertices_mm" in arrays and "occluder_faces" in arrays:
        occluder = (arrays["occluder_vertices_mm"], arrays["occluder_faces"])
    cameras = {"camera": arrays.get("camera"), "camera_positions": arrays.get("camera_positions_mm")}
    odds = float(arrays.get("texture_log_odds", np.zeros(())))
    with errors_of(file.name, GeometryImageError):
        return GeometryImage(**fields, **cameras, occluder=occluder, texture_log_odds=odds)  # type: ignore[arg-type]


def read_image_and_albedo(folder: Path) -> tuple[GeometryImage, Float32Array]:
    """Return the geometry image and the albedo (H, W, 3) of a result folder.

    Raises GeometryImageError or ScanError, naming the file, when one is missing, damaged or of another run.
    """
    files = folder / "geometry_image.npz", folder / "albedo.exr"
    for file in files:
        if not file.is_file():
            raise GeometryImageError(
                f"{file}: is missing; {folder} is not the folder of one processed scan (OUT/<scan name>), or "
                "its run was cut short: process the scan again, coloured and with the stage albedo"
            )
    image, albedo = read_geometry_image(files[0]), read_image_linear(files[1])
    if not image.mask.any():
        raise GeometryImageError(f"{files[0]}: its mask is empty: no surface; process the scan again")
    if albedo.shape[:2] != image.shape:
        said = f"{files[1]}: has {albedo.shape[:2]} texels and {files[0].name} {image.shape}"
        raise GeometryImageError(f"{said}; they come from different runs: process the scan again")
    return image, albedo
