"""URDFs of a few links without shapes, as text."""

from __future__ import annotations

HINGE = '<joint name="{n}" type="{t}"><parent link="{p}"/><child link="{c}"/><axis xyz="0 0 1"/>{x}</joint>'


def hinge(name, parent, child, kind="revolute", extra='<limit lower="-1" upper="1" effort="1" velocity="2"/>'):
    return HINGE.format(n=name, t=kind, p=parent, c=child, x=extra)


def robot_text(*parts, links=("a", "b")):
    return '<robot name="r">' + "".join(f'<link name="{link}"/>' for link in links) + "".join(parts) + "</robot>"
