"""Albedos of a batch as arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scan2albedo.batch.catalogue import load_catalogue
from scan2albedo.errors import BatchError
from scan2albedo.io.images import read_image_linear
from scan2albedo.io.npz import read_npz

_LEAST_WEIGHT = 0.5


def load_albedos(
    out: str | Path, size: int | None = None
) -> tuple[list[str], NDArray[np.float32], NDArray[np.bool_]]:
    """Return the albedos of all scans of a batch that are done and have one.

    Parameters
    ----------
    out : path
        Folder of the batch.
    size : int, optional
        Height and width to bring them to, by averages over the texels that were seen; as stored when omitted.

    Returns
    -------
    names : list of str
        Of the scans, in the manifest's order.
    albedo_linear : (N, size, size, 3) float32
        Texels correspond between scans of one face model; those of scans without a model do not.
    masks : (N, size, size) bool
        Texels that the scanner saw; others have the colour of the closest point of the scan.

    Raises
    ------
    BatchError
        When there is no such batch, no albedo, scans of several models or sizes, or a file is missing.
    ScanError
        When an albedo is damaged.
    """
    table = load_catalogue(out)
    columns = ("name", "model", "status", "path_albedo_exr")
    if missing := [name for name in columns if name not in table.column_names]:
        raise BatchError(f"{out}: its catalogue has no column {missing[0]}; `batch --resume` makes it anew")
    folder = Path(out) if Path(out).is_dir() else Path(out).parent
    wanted = [
        row for row in table.select(columns).to_pylist() if row["status"] == "done" and row["path_albedo_exr"]
    ]
    if not wanted:
        raise BatchError(f"{folder}: no scan of this batch has an albedo; see the reasons in its catalogue")
    if len(models := sorted({row["model"] for row in wanted})) > 1:
        raise BatchError(
            f"{folder}: scans of several models ({', '.join(models)}), whose texels do not correspond; "
            "process them in a batch each"
        )
    albedos: list[NDArray[np.float32]] = []
    masks: list[NDArray[np.bool_]] = []
    for row in wanted:
        albedo, seen = _stored(_inside(folder, str(row["path_albedo_exr"])))
        if size is not None and albedo.shape[:2] != (size, size):
            albedo, seen = _resized(albedo, seen, size)
        if albedos and albedo.shape != albedos[0].shape:
            raise BatchError(
                f"{folder}: {row['name']} has {albedo.shape[:2]} texels, {wanted[0]['name']} "
                f"{albedos[0].shape[:2]}; give a size"
            )
        albedos.append(albedo)
        masks.append(seen)
    return [row["name"] for row in wanted], np.stack(albedos), np.stack(masks)


def _inside(folder: Path, path: str) -> Path:
    """Return a file of a scan's folder in the batch; BatchError for a path that leads elsewhere."""
    if ".." in Path(path).parts or len(Path(path).parts) != 2 or (folder / path).parent.is_symlink():
        raise BatchError(
            f"{folder}: its catalogue names {path!r}, which is no file of a scan in it; "
            "`batch --resume` makes it anew"
        )
    return folder / path


def _stored(file: Path) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    albedo = read_image_linear(file)
    image = file.parent / "geometry_image.npz"
    arrays = read_npz(
        image,
        ("mask",),
        optional=("texture_valid",),
        what="geometry image",
        advice="run the batch with --resume",
        error=BatchError,
    )
    seen = arrays["mask"] & arrays.get("texture_valid", True)
    if seen.shape != albedo.shape[:2]:
        raise BatchError(f"{file}: has {albedo.shape[:2]} texels, {image.name} {seen.shape}: not of one run")
    return albedo, seen


def _resized(
    albedo: NDArray[np.float32], seen: NDArray[np.bool_], size: int
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return averages over the seen texels, over all where none was."""
    import cv2

    how = cv2.INTER_AREA if size <= len(albedo) else cv2.INTER_LINEAR
    weight = cv2.resize(seen.astype(np.float32), (size, size), interpolation=how)
    weighted = cv2.resize(albedo * seen[..., None].astype(np.float32), (size, size), interpolation=how)
    plain = cv2.resize(albedo, (size, size), interpolation=how)
    some = (weight > 0)[..., None]
    mean = np.where(some, weighted / np.where(some, weight[..., None], 1), plain)
    return mean.astype(np.float32), weight >= _LEAST_WEIGHT
