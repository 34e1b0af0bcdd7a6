from __future__ import annotations

from pathlib import Path

import hypothesis
import pytest
import torch
from random_robots import BOX_ARM

import grr_torch

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
