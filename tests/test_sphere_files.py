"""Files of spheres: what is written is read back, and what would be read otherwise than it is meant is refused."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from grr_torch.errors import FileFormatError
from grr_torch.robots.spheres import Sphere, SphereModel


def test_a_model_survives_its_file(kinova, tmp_path):
    kinova.spheres.save(tmp_path / "s.yaml", comment="two\nlines")
    again = SphereModel.load(tmp_path / "s.yaml", kinova.urdf.links)
    assert again == kinova.spheres
    tiny = SphereModel({"a": (Sphere((1e-7, 1 / 3, -2e-17), 1e-5),), "b": ()}, frozenset({("a", "b")}))
    assert SphereModel.parse(tiny.to_yaml(), ["a", "b"], source="tiny") == tiny


def test_a_model_of_numpy_numbers_survives_its_text():
    model = SphereModel({"a": (Sphere(tuple(np.array([0.1, 0.0, 1e-7])), np.float64(0.5)),)}, frozenset())
    assert SphereModel.parse(model.to_yaml(), ["a"], source="text") == model


@pytest.mark.parametrize(
    "text",
    [
        "collision_spheres:\n  a: [{center: [0, 0, 0], radius: 1}]\n  a: [{center: [1, 0, 0], radius: 1}]\n",
        "collision_spheres: {a: []}\nself_collision_ignore: {a: [b], a: [c]}\n",
    ],
)
def test_a_link_given_twice_is_refused(text):
    with pytest.raises(FileFormatError, match="'a' is given twice"):
        SphereModel.parse(text, ["a", "b", "c"], source="text")


@pytest.mark.parametrize("text", ["? [a, b]\n: c\n", "collision_spheres: !!map [1, 2]\n", "{[a]: 1}", "!!set {a, b}"])
def test_yaml_that_is_no_sphere_file_is_a_clear_error(text):
    with pytest.raises(FileFormatError, match="is not YAML|is not a sphere file"):
        SphereModel.parse(text, ["a", "b"], source="text")


def test_names_that_yaml_takes_for_something_else_survive():
    names = ["on", "No", "y", "null", "True", "~", "1e5", "0x1F", "1_0", "é", "a: b", "a#b", 'a"b', "a\\b", "a\tb", "-"]
    spheres = {name: (Sphere((0.0, 0.0, 1.0), 0.5),) for name in names}
    model = SphereModel(spheres, frozenset(itertools.pairwise(names)))
    assert SphereModel.parse(model.to_yaml(), names, source="text") == model
