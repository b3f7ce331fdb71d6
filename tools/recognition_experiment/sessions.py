"""One scan of the experiment: made, processed by the whole pipeline, and kept on disk."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from worlds.population import population_scan

from recognition_experiment.options import RecognitionExperimentOptions
from scan2albedo.albedo import estimate_albedo
from scan2albedo.errors import Scan2AlbedoError
from scan2albedo.io.atomic import make_folder
from scan2albedo.io.npz import read_npz, write_npz
from scan2albedo.pipeline.process import process

TEXTURE = "texture"


@dataclass(frozen=True)
class Session:
    """What became of one scan.

    Parameters
    ----------
    images : mapping of str to (H, W, 3) float
        Linear: the texture as scanned, and the albedo of each BRDF. Empty when the pipeline failed.
    seen : (H, W) bool
        Texels whose texture was seen.
    failure : str
        The pipeline's message; empty when it did not fail.
    brdfs : tuple of str
        What a scan that failed was tried with; another choice is tried anew.
    """

    images: Mapping[str, NDArray[np.floating]]
    seen: NDArray[np.bool_]
    failure: str = ""
    brdfs: tuple[str, ...] = ()


def session_file(cache: Path, options: RecognitionExperimentOptions, person: int, session: int) -> Path:
    """Return where a session is kept."""
    return cache / options.scans_key() / f"person-{person:04d}-session-{session}.npz"


def cached_session(
    cache: Path, options: RecognitionExperimentOptions, person: int, session: int
) -> Session | None:
    """Return a session from the disk, None when it is not there whole or lacks an albedo."""
    path = session_file(cache, options, person, session)
    try:
        arrays = read_npz(path, what="session", advice="it is made again", error=Scan2AlbedoError)
    except Scan2AlbedoError:
        return None
    if "seen" not in arrays or "failure" not in arrays:
        return None
    seen, failure = arrays.pop("seen"), str(arrays.pop("failure"))
    if failure:
        tried = tuple(str(name) for name in arrays.get("brdfs", ()))
        return Session({}, seen, failure, tried) if tried == options.brdfs else None
    if not {TEXTURE, *options.brdfs} <= set(arrays):
        return None
    return Session(arrays, seen)


def made_session(options: RecognitionExperimentOptions, person: int, session: int) -> Session:
    """Scan a person and process the scan, once through the whole pipeline and on for each further BRDF."""
    scan, _ = population_scan(person, session, seed=options.seed, population=options.population)
    seed = options.seed
    try:
        result = process(scan, size=options.size, brdf=options.brdfs[0], seed=seed)
        image, first = result.geometry_image, result.albedo
        if first is None or image.texture_linear is None:
            raise Scan2AlbedoError(f"{scan.name}: no albedo; {result.plan}")
        estimates = {options.brdfs[0]: first}
        for brdf in options.brdfs[1:]:
            estimates[brdf] = estimate_albedo(image, brdf=brdf, seed=seed)
    except Scan2AlbedoError as error:
        return Session({}, np.zeros((options.size, options.size), bool), str(error), options.brdfs)
    images = {TEXTURE: _kept(image.texture_linear, image.seen)}
    images |= {brdf: _kept(e.albedo_linear, image.seen) for brdf, e in estimates.items()}
    return Session(images, image.seen)


def keep_session(
    cache: Path, options: RecognitionExperimentOptions, person: int, session: int, made: Session
) -> None:
    """Write a session to the disk, whole or not at all.

    Raises
    ------
    OutputError
        When it cannot be written.
    """
    path = session_file(cache, options, person, session)
    make_folder(path.parent)
    arrays: dict[str, Any] = {"seen": made.seen, "failure": np.array(made.failure), **made.images}
    if made.failure:
        arrays["brdfs"] = np.array(made.brdfs)
    write_npz(path, arrays, what="session", compression=6)


def session_of(cache: Path, options: RecognitionExperimentOptions, person: int, session: int) -> Session:
    """Return a session, from the disk or made now and kept there."""
    kept = cached_session(cache, options, person, session)
    if kept is not None:
        return kept
    made = made_session(options, person, session)
    keep_session(cache, options, person, session, made)
    return made


def _kept(image: NDArray[np.floating], seen: NDArray[np.bool_]) -> NDArray[np.float16]:
    """Return the seen texels in half precision, whose steps of 0.05 % are below a camera's."""
    return np.where(seen[..., None], image, 0).astype(np.float16)
