"""Peers of the fit, run in the Python that S2A_PEERS_PYTHON names, or in this one."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import scan2albedo as s2a
from bench.peers import programs
from bench.runner import Timed
from scan2albedo.core.arrays import FloatArray
from scan2albedo.fitting.fit import CROP_MARGIN
from scan2albedo.fitting.scan_surface import scan_near_model

LEVEL = 1
"""Refinement of the model's surface that mesh peers deform."""


def peer_answer(name: str, given: dict[str, Any]) -> dict[str, Any]:
    """Return the arrays that a peer of `programs.py` writes for those that it is given.

    Raises
    ------
    ModuleNotFoundError
        With the last line of what it said, where it failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        source = f"{folder}/in.npz"
        np.savez(source, **given)
        python = os.environ.get("S2A_PEERS_PYTHON", sys.executable)
        command = [python, programs.__file__, name, source, f"{folder}/out.npz"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ModuleNotFoundError((done.stderr.strip() or f"{name} failed").splitlines()[-1])
        with np.load(Path(folder) / "out.npz") as stored:
            return dict(stored)


def deformed(
    name: str, scan: s2a.RawScan, model: s2a.AnnotatedFaceModel, model_from_scan: FloatArray
) -> Timed:
    """Return the vertices of the model's surface at `LEVEL` as a mesh peer lays them on a posed scan."""
    rest, faces = model.surface(LEVEL)
    low, high = rest.min(0), rest.max(0)
    margin = CROP_MARGIN * float(np.max(high - low))
    near = scan_near_model(scan.vertices, scan.faces, model_from_scan, low - margin, high + margin)
    given = {"scan_vertices": near.vertices, "scan_faces": near.faces}
    found = peer_answer(name, {"vertices": rest, "faces": faces, **given})
    return Timed(found["vertices"].astype(float), float(found["cpu_s"]))
