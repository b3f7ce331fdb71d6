"""The lighting model that the fits to photographs share; files of captures and photographs to spoil."""

import shutil
from functools import partial

import pytest
from helpers import json_files
from worlds.two_balls import build_scene

from scan2albedo.reflectance.lighting_model import LightingModel


@pytest.fixture(scope="session")
def lighting():
    return LightingModel.default()


@pytest.fixture(scope="session")
def scene():
    """A ball before a larger one, photographed."""
    return build_scene()


@pytest.fixture
def folder(written, tmp_path):
    """A copy of the folder of the file that a module has `written`."""
    shutil.copytree(written.parent, tmp_path / "copy")
    return tmp_path / "copy"


@pytest.fixture
def changed(written, folder):
    """Let a function change the content of the copy's file; returns its path."""
    return partial(json_files.changed, folder / written.name)
