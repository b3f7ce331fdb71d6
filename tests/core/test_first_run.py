"""Helpers beside a first run: when there are any, that they end with it, that what they compile is used."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from scan2albedo.core import first_run

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def four_cores(monkeypatch):
    """A machine on which there may be helpers, whatever the tests run with."""
    monkeypatch.delenv(first_run.SWITCH)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(4)), raising=False)


@pytest.mark.parametrize(("cores", "helpers"), [(3, 2), (4, 3), (64, 3)])
def test_each_further_core_has_a_helper_up_to_three(four_cores, monkeypatch, cores, helpers):
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(cores)), raising=False)
    assert first_run._helper_count() == helpers


FORBIDDEN = {
    "the switch": lambda patch: patch.setenv(first_run.SWITCH, "serial"),
    "one core": lambda patch: patch.setattr(os, "sched_getaffinity", lambda process: {0}, raising=False),
    "a worker": lambda patch: patch.setattr(first_run.multiprocessing, "parent_process", lambda: object()),
    "a frozen program": lambda patch: patch.setattr(sys, "frozen", True, raising=False),
    "a program with Python inside": lambda patch: patch.setattr(sys, "executable", "/opt/blender/blender"),
    "no executable known": lambda patch: patch.setattr(sys, "executable", None),
}


@pytest.mark.parametrize("why", FORBIDDEN)
def test_nobody_helps_where_it_could_do_harm(four_cores, monkeypatch, why):
    FORBIDDEN[why](monkeypatch)
    assert first_run._helper_count() == 0


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """A kernel of a module in `tmp_path`, kept in a folder there."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "kept"))
    monkeypatch.syspath_prepend(tmp_path)
    source = "from numba import njit\n\n\n@njit(cache=True)\ndef twice(x):\n    return 2 * x\n"
    (tmp_path / "kernel_of_a_test.py").write_text(source)
    monkeypatch.delitem(sys.modules, "kernel_of_a_test", raising=False)
    return importlib.import_module("kernel_of_a_test").twice


def test_kernels_are_cold_until_they_are_kept(kernel):
    assert first_run._is_cold([kernel])
    kernel(1.0)
    assert not first_run._is_cold([kernel])


def test_kernels_of_older_source_are_removed(kernel, tmp_path):
    kernel(1.0)
    kept = [path for path in (tmp_path / "kept").rglob("*.nb*") if path.name.startswith("kernel_of_a_test")]
    assert kept
    for path in kept:
        os.utime(path, (0, 0))
    assert first_run._is_cold([kernel])
    assert not any(path.exists() for path in kept)


def test_kernels_of_source_from_the_future_are_kept(kernel, tmp_path):
    os.utime(tmp_path / "kernel_of_a_test.py", (4e9, 4e9))
    kernel(1.0)
    assert not first_run._is_cold([kernel])
    assert any(path.name.startswith("kernel_of_a_test") for path in (tmp_path / "kept").rglob("*.nbi"))


def test_nothing_is_cold_where_nothing_can_be_kept(kernel, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert not first_run._is_cold([kernel])
    assert not first_run._is_cold([kernel.py_func])


def test_every_recorded_kernel_is_one_of_the_package():
    kernels = first_run.recorded_kernels()
    assert len(kernels) >= 20
    for kernel in kernels:
        assert callable(kernel.dispatcher().py_func)
        assert kernel.argument_types()


def test_helpers_end_with_the_block_and_with_their_parent(four_cores, monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    started = []
    monkeypatch.setattr(first_run, "_is_cold", lambda kernels: True)
    monkeypatch.setattr(first_run, "_helper_count", lambda: 1)
    start = first_run._started
    monkeypatch.setattr(first_run, "_started", lambda count: started.extend(start(count)) or started)
    with first_run.compiled_beside():
        (helper,) = started
        assert helper.poll() is None
        with first_run.compiled_beside():
            assert len(started) == 1
    assert helper.poll() is not None

    (orphan,) = start(1)
    assert orphan.poll() is None
    orphan.stdin.close()
    assert orphan.wait(60) == 0


def test_a_failing_helper_changes_nothing(four_cores, monkeypatch):
    monkeypatch.setattr(first_run, "_is_cold", lambda kernels: True)
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with first_run.compiled_beside():
        value = np.ones(1)
    assert value[0] == 1


COMPILED = """
from numba.core import event

from scan2albedo.core import first_run

compiled = []


class Names(event.Listener):
    def on_start(self, compile):
        compiled.append(compile.data["dispatcher"].py_func.__qualname__)

    def on_end(self, compile):
        pass


event.register("numba:compile", Names())
for kernel in first_run.recorded_kernels():
    kernel.dispatcher().compile(kernel.argument_types())
print(*compiled)
"""


@pytest.mark.slow
def test_the_record_is_what_a_run_compiles_and_helpers_compile_it(monkeypatch, tmp_path):
    """To mend it, run `python tools/record_kernels.py`."""
    monkeypatch.syspath_prepend(ROOT / "tools")
    lines = importlib.import_module("record_kernels").recorded()
    kept = [" ".join(kernel) for kernel in first_run.recorded_kernels()]
    assert lines == kept

    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(ROOT)}
    helper = subprocess.Popen(
        [sys.executable, "-m", "scan2albedo.core.first_run", "0", "1"], stdin=subprocess.PIPE, env=environment
    )
    assert helper.wait(300) == 0
    helper.stdin.close()
    done = subprocess.run(
        [sys.executable, "-c", COMPILED], env=environment, stdout=subprocess.PIPE, text=True, check=True
    )
    # Of several signatures of one function, none is left to helpers.
    names = [kernel.function for kernel in first_run.recorded_kernels()]
    several = {name for name in names if names.count(name) > 1}
    assert {name for name in done.stdout.split() if name in names} <= several
