from __future__ import annotations

import warnings
from pathlib import Path

import hypothesis
import pytest
import torch
from grr_torch.cli.main import run as run_command
from random_robots import BOX_ARM

import grr_torch
from grr_torch import NeuralIK, TrainingOptions, train_ik
from grr_torch.experiments.paths import draw_paths
from grr_torch.learning.network import Architecture

# how long an example takes is the machine's affair
hypothesis.settings.register_profile("any machine", deadline=None)
hypothesis.settings.load_profile("any machine")

REAL_MESHES = Path(__file__).resolve().parents[2] / "shared" / "meshes"


@pytest.fixture(scope="session")
def kinova() -> grr_torch.Robot:
    return grr_torch.load_robot("kinova")


@pytest.fixture(scope="session")
def planar_5() -> grr_torch.Robot:
    return grr_torch.load_robot("planar_5")


@pytest.fixture(scope="session")
def planar_roadmap(planar_5) -> grr_torch.Roadmap:
    return grr_torch.build(planar_5, "position", points=300, reachability=8)


@pytest.fixture(scope="session")
def kinova_roadmap(kinova) -> grr_torch.Roadmap:
    """The Kinova's, gripper down, refined."""
    return grr_torch.build(kinova, "fixed-rotation")


@pytest.fixture(scope="session")
def through_holes(kinova_roadmap) -> torch.Tensor:
    """Targets (200, 40, 3) on lines through the Kinova's base."""
    return draw_paths(kinova_roadmap, "line_self", 40, seed=3).transpose(0, 1)


@pytest.fixture(scope="session")
def tiny_ik(planar_roadmap) -> NeuralIK:
    """A network that has hardly learned the planar roadmap."""
    architecture = Architecture(width=32, depth=2, waves=4)
    return train_ik(planar_roadmap, TrainingOptions(samples=3000, epochs=3, batch=256, architecture=architecture))


@pytest.fixture
def load(tmp_path):
    """Loads a robot from the text of a URDF."""

    def read(text, **options):
        path = tmp_path / "robot.urdf"
        path.write_text(text)
        return grr_torch.load_robot(path, **options)

    return read


@pytest.fixture
def run_cli(tmp_path, monkeypatch, capfd):
    """Runs a command in a folder of its own; gives its exit code and what it printed."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        code = 0
        with warnings.catch_warnings():
            try:
                run_command([str(word) for word in words])
            except SystemExit as end:
                code = end.code or 0
        return code, *capfd.readouterr()

    return run


@pytest.fixture
def box_arm(tmp_path) -> Path:
    path = tmp_path / "box_arm.urdf"
    path.write_text(BOX_ARM)
    return path


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="session")
def real_meshes() -> Path:
    if not REAL_MESHES.is_dir():
        pytest.skip("the vendors' meshes are not beside the repository")
    return REAL_MESHES
