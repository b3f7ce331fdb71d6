"""Each command loads the costly libraries that it uses, and no others."""

import subprocess
import sys

import pytest
from worlds.files import write_obj

COSTLY = """
    OpenEXR PIL cholespy cv2 distributed embreex h5py igl jinja2 joblib matplotlib mpl_toolkits numba open3d
    pandas pyarrow pyrtools scipy skimage sklearn trimesh xatlas
"""
PROGRAM = """
import atexit, sys
from scan2albedo.cli import main
atexit.register(lambda: print(*{name.partition(".")[0] for name in sys.modules}, file=sys.stderr))
main()
"""
USED = {
    "--help": "",
    "doctor": "numba scipy",
    "process scan.obj -o . --files minimal": "OpenEXR PIL cholespy embreex igl numba scipy skimage",
    "relight scan -o relit.png --light 45,20": "OpenEXR PIL embreex numba scipy",
    "swap scan scan -o swapped": "OpenEXR PIL embreex numba scipy",
    "report scan": "OpenEXR PIL embreex jinja2 numba scipy",
    # The steerable pyramid of pyrtools loads matplotlib.
    "identify --gallery . --probes .": "OpenEXR PIL matplotlib mpl_toolkits numba pyrtools scipy skimage",
}
"""Commands, one after the other in a folder with a scan, and the libraries that each may load."""


@pytest.mark.slow
def test_a_command_loads_what_it_uses(coarse_scan, tmp_path):
    write_obj(coarse_scan[0], tmp_path / "scan.obj")
    for words, used in USED.items():
        command = [sys.executable, "-c", PROGRAM, *words.split()]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode in (0, 1), done.stderr
        loaded = set(COSTLY.split()) & set(done.stderr.splitlines()[-1].split())
        assert not loaded - set(used.split()), words
