"""What the commands for glasses are given: frames, cameras and the rest of their files, in millimetres."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from scan2albedo import eyeglasses
from scan2albedo.core import RawScan
from scan2albedo.core.arrays import BoolArray, FloatArray, IntArray, Texts, Values, finite_rows
from scan2albedo.errors import EyeglassesError, errors_of
from scan2albedo.eyeglasses import Camera, LensMaterial, read_cameras, write_keypoints
from scan2albedo.eyeglasses.frame_files import read_keypoints_with_unit
from scan2albedo.eyeglasses.keypoints import KEY_POINT_NAMES
from scan2albedo.eyeglasses.mean_keypoints import WIDTHS_MM, front_width
from scan2albedo.eyeglasses.proposed_keypoints import HARDLY_A_FRAME
from scan2albedo.eyeglasses.view_files import MASK_ENDINGS, file_of_camera
from scan2albedo.geometry.closest_points import ClosestPointQuery
from scan2albedo.geometry.rasterization import within
from scan2albedo.io.atomic import atomic_path, check_writable
from scan2albedo.io.color import encode_srgb_bytes
from scan2albedo.io.images import read_image_linear
from scan2albedo.io.input_hash import file_sha256, input_sha256
from scan2albedo.io.load_scan import load_scan, load_scan_with
from scan2albedo.io.parsed_mesh import ParsedMesh
from scan2albedo.io.records import Record
from scan2albedo.io.result_records import SHA256
from scan2albedo.io.units import MM_PER_UNIT, PLAUSIBLE_GLASSES_MM, check_unit, glasses_millimetres_per_unit
from scan2albedo.report.eyeglasses_views import key_point_chart

CANONICAL = ".npz"
"""Extension of frames that bring their weights, and of results whose pose is a start."""
_SUNGLASSES = LensMaterial(
    tint_linear=(0.1, 0.07, 0.03), alpha=0.85, beta=0.04, fresnel=True, tinting="filter"
)
"""Dyed glass of index 1.5, which mirrors 4 % head-on."""


class FileRecord(Record):
    """A file that a result was made from."""

    file: str = Field(description="Path as given.")
    sha256: str = Field(pattern=SHA256, description="Of a mesh: with the files it refers to.")


@dataclass(frozen=True)
class GlassesFrame:
    """A frame as read: mesh and key points (20, 3) in mm, NaN for missing ones, weights (V, 20) if any.

    `mm_per_unit` is that of the mesh's file; `files` are "mesh" and, where it is a file, "keypoints".
    """

    name: str
    scan: RawScan
    keypoints: FloatArray
    mm_per_unit: float
    files: Mapping[str, FileRecord]
    weights: FloatArray | None = None
    deviations_mm: Mapping[str, float] = field(default_factory=dict)
    """Of the key points that nobody placed, by name."""

    @property
    def missing_key_points(self) -> Texts:
        """Names of the key points that the file leaves out."""
        return tuple(compress(KEY_POINT_NAMES, ~finite_rows(self.keypoints)))


@dataclass(frozen=True)
class GlassesInput:
    """What a frame is registered on a face from, or its lenses are drawn with; lengths in mm.

    `files` are named "mesh", "cameras", "mask <camera>", "picture <camera>" and others; `labels` (C, 20, 2)
    are NaN for missing ones, `start` (4, 4) is `world_from_glasses`, `pictures` and `environment` are linear,
    `rim_masks` camera matrices (3, 4) and masks of `refine_lens_rim`.
    """

    frame: GlassesFrame
    cameras: tuple[Camera, ...]
    head: RawScan | None
    files: Mapping[str, FileRecord]
    notes: Texts = ()
    labels: FloatArray | None = None
    masks: tuple[BoolArray | None, ...] = ()
    start: FloatArray | None = None
    pictures: tuple[Any, ...] | None = None
    environment: FloatArray | None = None
    rim_masks: tuple[tuple[FloatArray, BoolArray], ...] = ()


def keypoints_path(mesh: Path) -> Path:
    """Return where a mesh's key points are looked for: ``<stem>.keypoints.json`` beside it."""
    return mesh.with_name(f"{mesh.stem}.keypoints.json")


def read_frame(
    mesh: Path,
    keypoints: Path | None = None,
    unit: str = "auto",
    widths_mm: tuple[float, float] | None = None,
    *,
    frame_width_mm: float | None = None,
    mm_per_unit: float | None = None,
    fill: bool = False,
) -> GlassesFrame:
    """Read a mesh and its key points, ``<stem>.keypoints.json`` beside it when omitted.

    Without either they are proposed from the mesh; with `fill` those that nobody placed are.

    The front's true width, or the scale of another frame's file, goes before all units. The mesh's unit
    "auto" is the one in which the key points lie on it, when their file states their own; otherwise the
    front's width decides, and where it fits no unit, or several, the size of the glasses. A front outside
    `widths_mm` is refused when they are given. Raises EyeglassesError or ScanError, naming the file, when one
    cannot be read or has another size; ValueError for an unknown unit.
    """
    check_unit(unit)
    marks_file = keypoints_path(mesh) if keypoints is None else keypoints
    marks, marks_unit = np.full((len(KEY_POINT_NAMES), 3), np.nan), "unknown"
    placed = keypoints is not None or (marks_file.is_file() and not fill)
    if placed:
        marks, marks_unit = read_keypoints_with_unit(marks_file)
    own = finite_rows(marks)
    deviations: dict[str, float] = {}
    messages: list[str] = []
    width_range = WIDTHS_MM if widths_mm is None else widths_mm
    low, high = (np.array(PLAUSIBLE_GLASSES_MM) * width_range / WIDTHS_MM).tolist()
    marks_mm = MM_PER_UNIT.get(marks_unit, 0.0)
    scale = 0.0
    ratio = 1.0

    def decide(parsed: ParsedMesh, components: IntArray) -> tuple[float, str]:
        nonlocal scale, ratio, marks
        scale, how = MM_PER_UNIT.get(unit, 0.0), f"{unit}, as given"
        if marks_mm and not scale:
            # The unit in which the key points lie on the mesh: units are factors of ten apart.
            known = marks[finite_rows(marks)] * marks_mm
            query = ClosestPointQuery(parsed.vertices, parsed.faces).query
            away = {u: mm * np.median(query(known / mm).distance) for u, mm in MM_PER_UNIT.items()}
            found = min(away, key=lambda u: away[u])
            # Farther off than a tenth of their size, key points are those of another mesh.
            if not 10 * away[found] <= np.ptp(known, axis=0).max():
                raise EyeglassesError(
                    f"{mesh.name}: in no unit do the key points lie on the mesh: at best, in {found}, they "
                    f"are {away[found]:.3g} mm off; check that they are this mesh's, and their file's unit"
                )
            scale, how = MM_PER_UNIT[found], f"{found}, decided from the key points on it, in {marks_unit}"
        ratio = marks_mm / scale if marks_mm else 1.0
        proposed = None
        if fill or not placed:
            with errors_of(mesh.name, EyeglassesError):
                proposed = eyeglasses.propose_keypoints((parsed.vertices, parsed.faces))
            marks = np.where(own[:, None], marks, proposed.points / ratio)
            stated = zip(KEY_POINT_NAMES, proposed.deviation, own, strict=True)
            deviations.update({n: sd for n, sd, by_hand in stated if np.isfinite(sd) and not by_hand})
            messages.append(proposed_note(deviations, own.sum(), proposed.log_odds))
        width = front_width(ratio * marks, parsed.vertices)
        if mm_per_unit is not None or frame_width_mm is not None:
            scale = mm_per_unit or (frame_width_mm or 0.0) / width
            how = f"{scale:.4g} mm, {'as in the first file' if mm_per_unit else 'from --frame-width'}"
            if not scale > 0:
                raise EyeglassesError(f"{mesh.name}: place both hinges or both rim_outer for --frame-width")
        elif scale:
            owner = (marks_unit, marks_file.name) if marks_mm else (unit, mesh.name)
            glasses_millimetres_per_unit(marks, *owner, (low, high))
        elif proposed is not None and proposed.unit != "unknown":
            scale, how = proposed.mm_per_unit, f"{proposed.unit}, in which a mean face wears it"
        else:
            fits = [u for u, mm in MM_PER_UNIT.items() if width_range[0] <= width * mm <= width_range[1]]
            if len(fits) == 1:
                scale, how = MM_PER_UNIT[fits[0]], f"{fits[0]}, decided from its front's width"
            elif fits or widths_mm is None or not width > 0:
                scale, how = glasses_millimetres_per_unit(marks, unit, mesh.name, (low, high))
                how = how.removeprefix("unit: ")
            how += " (assumed: `canonicalize` and `register` take the true one, such as --frame-width 140)"
        size = f"front {width:.4g} units wide" + f", {width * scale:.4g} mm" * (scale > 0)
        if widths_mm is not None and width > 0 and not width_range[0] <= width * scale <= width_range[1]:
            raise EyeglassesError(
                f"{mesh.name}: {size}{f' (unit: {how})' if scale else ' in the file'}, but spectacles are "
                f"{width_range[0]:g} to {width_range[1]:g} mm wide: give what the front measures by "
                "--frame-width, or admit other --widths"
            )
        return scale, f"unit: {how}; {size}" if width > 0 else f"unit: {how}"

    scan = load_scan_with(mesh, decide)
    scan = replace(scan, notes=(*scan.notes, *messages))
    files = {"mesh": _hashed(mesh, mesh=True)} | ({"keypoints": _hashed(marks_file)} if placed else {})
    return GlassesFrame(scan.name, scan, marks * ratio * scale, scale, files, deviations_mm=deviations)


def proposed_note(deviations_mm: Mapping[str, float], placed: int, log_odds: float) -> str:
    """Return a sentence about key points that were proposed, and which of them are unsure."""
    unsure = [f"{name} ({sd:.1f} mm)" for name, sd in deviations_mm.items() if sd > 3]
    count = len(deviations_mm)
    missing = len(KEY_POINT_NAMES) - placed - count
    said = f"{count} key points are proposed from its shape, {placed} placed, {missing} not found"
    if count:
        said += f"; median deviation {np.median(list(deviations_mm.values())):.1f} mm"
    if log_odds < HARDLY_A_FRAME:
        said += f"; it is hardly like a frame (log odds {log_odds:.0f})"
    return f"{said}{'; unsure: ' + ', '.join(unsure) if unsure else ''}: look at `glasses key-points`"


def read_registration(
    mesh: Path,
    cameras: Path,
    labels: Path | None = None,
    *,
    pictures: Path | None = None,
    masks: Path | None = None,
    head: Path | None = None,
    keypoints: Path | None = None,
    start: Path | None = None,
    unit: str = "auto",
    frame_width_mm: float | None = None,
) -> GlassesInput:
    """Read the files of a registration.

    `mesh` has key points beside it, or is a `canonical.npz`; `masks` and `pictures` are folders of files
    named after the cameras, `head` a mesh in the cameras' frame, `start` a pose or a `registered.npz`; the
    unit is that of the mesh. Raises EyeglassesError or ScanError, naming the file, when one cannot be read or
    does not fit; ValueError for an unknown unit, or key points that the frame already has.
    """
    views = read_cameras(cameras)
    files = {"cameras": _hashed(cameras)}
    notes: list[str] = []
    pixels = np.full((len(views), len(KEY_POINT_NAMES), 2), np.nan)
    if labels is not None:
        files["labels"] = _hashed(labels)
        listed = eyeglasses.read_labels(labels)
        with errors_of(f"labels {labels}", EyeglassesError):
            pixels = listed.of_cameras([camera.name for camera in views])
    for camera, marks in zip(views, pixels, strict=True):
        labelled = marks[finite_rows(marks)]
        outside = (~within(labelled, camera.shape, 0.5)).sum()
        if len(labelled) == 0:
            notes.append(f"no label in the view of {camera.name!r}")
        elif outside:
            size, whose = f"{camera.shape[1]} x {camera.shape[0]} pixels", f"labels of {camera.name!r}"
            notes.append(f"{outside} of {len(labelled)} {whose} lie outside its picture of {size}")
    found = _read_per_camera("mask", masks, views, files, notes)
    photographs = _read_per_camera("picture", pictures, views, files, notes)
    pose = None
    if start is not None:
        npz = start.suffix.lower() == CANONICAL
        pose = eyeglasses.read_registered(start).world_from_glasses if npz else eyeglasses.read_start(start)
        files["start"] = _hashed(start)
    read: list[tuple[str, RawScan]] = []
    if mesh.suffix.lower() == CANONICAL:
        if keypoints is not None or unit not in ("auto", "mm") or frame_width_mm is not None:
            raise ValueError(f"{mesh.name} brings its own key points, and is in mm")
        made, own = eyeglasses.read_canonical(mesh), {"mesh": _hashed(mesh)}
        # All canonical frames' files are called alike, their folders are not.
        folder = mesh.absolute().parent.name
        name = folder if mesh.name == "canonical.npz" and folder else mesh.stem
        frame = GlassesFrame(name, RawScan(made.vertices, made.faces), made.keypoints, 1.0, own, made.weights)
    else:
        frame = read_frame(mesh, keypoints, unit, frame_width_mm=frame_width_mm)
        read.append((mesh.name, frame.scan))
    skull = None
    if head is not None:
        skull = load_scan(head)
        read.append((f"head {head.name}", skull))
        files["head"] = _hashed(head, mesh=True)
    # That meshes have no colours does not matter here.
    notes += [f"{name}: {n}" for name, scan in read for n in scan.notes if "geometry only" not in n]
    read_files = {**files, **frame.files}
    seen = None if pictures is None else photographs
    return GlassesInput(frame, views, skull, read_files, tuple(notes), pixels, found, pose, seen)


def read_lens_scene(
    frame: Path,
    head: Path,
    cameras: Path,
    *,
    keypoints: Path | None = None,
    masks: Path | None = None,
    views: Sequence[str] = (),
    pictures: Sequence[Path] = (),
    environment: Path | None = None,
    unit: str = "auto",
) -> GlassesInput:
    """Read the files of a rendering; the unit is that of both meshes, and "auto" decides for each.

    Key points are otherwise ``<frame stem>.keypoints.json`` or ``keypoints.json`` beside the frame. `views`
    name cameras, all when there are none; `pictures`, one a view, are named after them or in their order;
    `masks` is a folder of masks of the frame, of any of the cameras. Raises EyeglassesError or ScanError,
    naming the file, when one cannot be read or does not fit the others.
    """
    every = read_cameras(cameras)
    by_name = {camera.name: camera for camera in every}
    if strange := [name for name in views if name not in by_name]:
        raise EyeglassesError(
            f"cameras {cameras}: there is no view {strange[0]!r}, only {', '.join(by_name)}"
        )
    chosen = tuple(by_name[name] for name in dict.fromkeys(views)) or every
    if keypoints is None and not keypoints_path(frame).is_file():
        shared = frame.with_name("keypoints.json")
        keypoints = shared if shared.is_file() else None
    if pictures and len(pictures) != len(chosen):
        names = ", ".join(camera.name for camera in chosen)
        said = f"there are {len(pictures)} pictures for {len(chosen)} views ({names})"
        raise EyeglassesError(f"picture {pictures[0]}: {said}; give one a view, and choose views by --view")
    stems = {picture.stem: picture for picture in pictures}
    if all(camera.name in stems for camera in chosen):
        pictures = [stems[camera.name] for camera in chosen]
    glasses, skull = read_frame(frame, keypoints, unit), load_scan(head, unit)
    files = {**glasses.files, "head": _hashed(head, mesh=True), "cameras": _hashed(cameras)}
    images = []
    for file, camera in zip(pictures, chosen if pictures else (), strict=True):
        images.append(_read_picture(file, camera))
        files[f"picture {camera.name}"] = _hashed(file)
    notes = [f"frame: {note}" for note in glasses.scan.notes] + [f"head: {note}" for note in skull.notes]
    seen = zip(every, _read_per_camera("mask", masks, every, files, notes), strict=True)
    rims = tuple((camera.matrix, mask) for camera, mask in seen if mask is not None)
    light = None
    if environment is not None:
        light, files["environment"] = np.asarray(read_image_linear(environment), float), _hashed(environment)
    shown = tuple(images) or None
    return GlassesInput(
        glasses, chosen, skull, files, tuple(notes), pictures=shown, environment=light, rim_masks=rims
    )


def numbers(name: str, text: str, *counts: int) -> tuple[float, ...]:
    """Return the numbers of an option's text, commas between them; ValueError unless as many as expected."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"{name} takes numbers with commas between them, got {text!r}") from None
    if len(values) not in counts:
        wanted = " or ".join(str(c) for c in counts)
        raise ValueError(f"{name} takes {wanted} numbers, got {len(values)} in {text!r}")
    return values


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

    Raises ValueError for a text that is not as many numbers, EyeglassesError for one out of range.
    """
    powers = numbers("--dioptres", dioptres, 1, 2)
    glass = _SUNGLASSES
    if not sunglasses:
        glass = LensMaterial(beta=_SUNGLASSES.beta if fresnel else 0.0, fresnel=fresnel)
    changes: Values = {"alpha": alpha, "beta": beta}
    if tint is not None:
        changes["tint_linear"] = numbers("--tint", tint, 3)
        if alpha is None and not sunglasses:
            changes["alpha"] = 0.5
    changes = {name: value for name, value in changes.items() if value is not None}
    return replace(glass, dioptres=powers[0], **changes), replace(glass, dioptres=powers[-1], **changes)


def _read_per_camera(
    kind: str, folder: Path | None, cameras: Sequence[Camera], files: dict[str, FileRecord], notes: list[str]
) -> tuple[Any, ...]:
    """Return the masks or pictures of a folder, None where it has none, and add files and notes."""
    found: list[Any] = [None] * len(cameras)
    if folder is None:
        return tuple(found)
    endings = MASK_ENDINGS if kind == "mask" else (".png", ".jpg", ".jpeg", ".tif")
    for number, camera in enumerate(cameras):
        path = file_of_camera(folder, camera, endings)
        if path is None:
            notes.append(f"no {kind} of {camera.name!r}: {folder} has no {camera.name}{' or '.join(endings)}")
            continue
        if kind == "mask":
            (found[number],) = eyeglasses.read_masks(folder, [camera])
        else:
            found[number] = encode_srgb_bytes(_read_picture(path, camera))
        files[f"{kind} {camera.name}"] = _hashed(path)
    if all(one is None for one in found):
        names = ", ".join(camera.name + endings[0] for camera in cameras)
        more = f" (or {', '.join(endings[1:])})" if len(endings) > 1 else ""
        raise EyeglassesError(f"{kind}s {folder}: the folder holds none of {names}{more}")
    return tuple(found)


def _read_picture(file: Path, camera: Camera) -> FloatArray:
    """Return the linear picture (H, W, 3) of a camera."""
    image = np.asarray(read_image_linear(file, upright=True), float)
    if image.shape[:2] != camera.shape:
        (height, width), (wanted_height, wanted_width) = image.shape[:2], camera.shape
        raise EyeglassesError(
            f"picture {file} is {width} x {height} pixels, the view {camera.name!r} {wanted_width} x "
            f"{wanted_height}; give the picture that this camera took"
        )
    return image


def _hashed(path: Path, *, mesh: bool = False) -> FileRecord:
    try:
        return FileRecord(file=str(path), sha256=input_sha256(path) if mesh else file_sha256(path))
    except OSError as error:
        raise EyeglassesError(f"{path}: {error.strerror}; check the path") from error


def write_proposed(
    mesh: Path, out: Path | None, placed: Path | None, unit: str, say: Callable[[str], None]
) -> None:
    """Write a frame's proposed key points in mm, and a picture of them beside the file.

    Placed ones, in a file of their own, stay. Raises EyeglassesError or ScanError, naming the file, when one
    cannot be read, shows no frame or is there already; OutputError when writing fails.
    """
    target = keypoints_path(mesh) if out is None else out
    if target.is_file():
        raise EyeglassesError(f"{target} is there already: move it, or give -o another name")
    check_writable(target.parent)
    frame = read_frame(mesh, placed, unit, fill=True)
    for note in frame.scan.notes:
        say(f"{frame.name}: {note}")
    chart = key_point_chart(frame.scan, frame.keypoints, frame.deviations_mm)
    with atomic_path(target.with_suffix(".png")) as staging:
        chart.savefig(staging, format="png")
    write_keypoints(target, frame.keypoints, "mm", frame.deviations_mm)
    say(f"{frame.name}: key points in {target}, to look at: {target.with_suffix('.png')}")
