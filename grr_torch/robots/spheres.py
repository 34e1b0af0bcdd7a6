"""Sphere models: spheres fixed to links and the pairs of links that are not checked, read from and written to YAML."""

from __future__ import annotations

import itertools
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from grr_torch.errors import FileFormatError, ParameterError, UnknownNameError
from grr_torch.output import atomic_write
from grr_torch.strict_yaml import parse_yaml

# what YAML 1.1 takes for a truth value, or none
_NOT_TEXT = ("y", "yes", "n", "no", "true", "false", "on", "off", "null")


@dataclass(frozen=True)
class Sphere:
    """A sphere fixed to a link.

    Attributes:
        center: (x, y, z) in the link's frame [m].
        radius: [m].
    """

    center: tuple[float, float, float]
    radius: float


@dataclass(frozen=True)
class SphereModel:
    """The self-collision model of a robot.

    Attributes:
        spheres: Spheres by link.
        ignored: Pairs of links that are not checked; each is put in alphabetical order.
    """

    spheres: Mapping[str, tuple[Sphere, ...]]
    ignored: frozenset[tuple[str, str]]

    def __post_init__(self) -> None:
        pairs = [tuple(pair) for pair in self.ignored if not isinstance(pair, str)]
        if len(pairs) < len(self.ignored) or any(len(pair) != 2 for pair in pairs):
            raise ParameterError("ignored", self.ignored, "pairs of links")
        object.__setattr__(self, "ignored", frozenset(ordered_pair(*pair) for pair in pairs))

    def check_links(self, links: Sequence[str]) -> None:
        """Looks up all links that are named.

        Raises:
            UnknownNameError: One is not among a robot's links.
        """
        for link in (*self.spheres, *itertools.chain(*sorted(self.ignored))):
            if link not in links:
                raise UnknownNameError("link", link, links, " (named by the sphere model)")

    @property
    def checked(self) -> list[tuple[str, str]]:
        """Pairs of links that have spheres and are not ignored."""
        links = [link for link, of_link in self.spheres.items() if of_link]
        return [pair for pair in itertools.combinations(links, 2) if ordered_pair(*pair) not in self.ignored]

    def to_yaml(self) -> str:
        """The model in cuRobo's shape: `collision_spheres` and `self_collision_ignore`."""
        lines = ["collision_spheres:"]
        for link, of_link in self.spheres.items():
            lines.append(f"  {_quoted(link)}:" + ("" if of_link else " []"))
            for sphere in of_link:
                # every digit is kept: a roadmap file carries the model as this text
                center = ", ".join(_number(value) for value in sphere.center)
                lines.append(f"  - {{center: [{center}], radius: {_number(sphere.radius)}}}")
        lines.append("self_collision_ignore:" + ("" if self.ignored else " {}"))
        for first in sorted({pair[0] for pair in self.ignored}):
            others = sorted(pair[1] for pair in self.ignored if pair[0] == first)
            lines.append(f"  {_quoted(first)}: [{', '.join(map(_quoted, others))}]")
        return "\n".join(lines) + "\n"

    def save(self, path: str | os.PathLike[str], *, comment: str = "") -> None:
        """Writes the YAML file, by an atomic rename; `comment` goes on top of it.

        Raises:
            OutputError: It cannot be written.
        """
        head = "".join(f"# {line}\n" for line in comment.splitlines())
        with atomic_write(path) as temporary:
            temporary.write_text(head + self.to_yaml(), encoding="utf-8")

    @staticmethod
    def load(path: str | os.PathLike[str], links: Sequence[str]) -> SphereModel:
        """Reads a YAML file for a robot with these links.

        Raises:
            FileFormatError: It is missing or not a sphere file.
            UnknownNameError: It names a link that the robot does not have.
        """
        try:
            text = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "not text"
            raise FileFormatError(path, f"cannot be read: {reason}") from error
        return SphereModel.parse(text, links, source=str(path))

    @staticmethod
    def parse(text: str, links: Sequence[str], *, source: str) -> SphereModel:
        """Reads YAML text; see `load`."""
        data = parse_yaml(text, source)
        for outer in ("robot_cfg", "kinematics"):  # cuRobo nests both entries in these
            if isinstance(data, dict) and outer in data:
                data = data[outer]
        if not isinstance(data, dict) or not isinstance(data.get("collision_spheres"), dict):
            raise FileFormatError(source, "is not a sphere file: it has no mapping 'collision_spheres'")
        spheres = {_link(link, links): _spheres(source, link, v) for link, v in data["collision_spheres"].items()}
        ignore = data.get("self_collision_ignore") or {}
        if not isinstance(ignore, dict) or not all(isinstance(v, list) for v in ignore.values()):
            raise FileFormatError(source, "'self_collision_ignore' must map a link to a list of links")
        ignored = {(_link(a, links), _link(b, links)) for a, others in ignore.items() for b in others}
        return SphereModel(spheres, frozenset(ignored))


def ordered_pair(first: str, second: str) -> tuple[str, str]:
    """The two names in alphabetical order."""
    return (first, second) if first < second else (second, first)


def _number(value: float) -> str:
    text = repr(float(value))
    # YAML 1.1 takes 1e-05 for text and 1.0e-05 for a number
    return text if "e" not in text or "." in text else text.replace("e", ".0e")


def _quoted(name: str) -> str:
    plain = name.replace("_", "").isalnum() and not name[0].isdigit() and name.lower() not in _NOT_TEXT
    return name if plain else json.dumps(name, ensure_ascii=False)


def _link(name: Any, links: Sequence[str]) -> str:
    if name not in links:
        raise UnknownNameError("link", str(name), links, " (named by the sphere file)")
    return str(name)


def _spheres(source: str, link: str, items: Any) -> tuple[Sphere, ...]:
    if not isinstance(items, list | None):
        raise FileFormatError(source, f"link '{link}': got {items}; valid: a list of spheres")
    spheres: list[Sphere] = []
    for item in items or []:
        try:
            x, y, z = map(float, item["center"])
            radius = float(item["radius"])
        except (TypeError, KeyError, ValueError, OverflowError) as error:
            raise FileFormatError(
                source, f"link '{link}': got {item}; valid: {{center: [x, y, z], radius: r}}"
            ) from error
        if not all(map(math.isfinite, (x, y, z, radius))):
            raise FileFormatError(source, f"link '{link}' has a sphere that is not finite: {item}")
        if radius > 0.0:  # cuRobo marks disabled spheres by a radius below zero
            spheres.append(Sphere((x, y, z), radius))
    return tuple(spheres)
