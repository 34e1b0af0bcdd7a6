"""Kinematic figures of arms nobody tuned anything for, as URDF: from their makers' published descriptions."""

from __future__ import annotations

from math import pi

# xyz and rpy of each joint's frame, lower and upper limit; all turn about z; last, where the tool is
PANDA = (
    [
        ((0, 0, 0.333), (0, 0, 0), -2.8973, 2.8973),
        ((0, 0, 0), (-pi / 2, 0, 0), -1.7628, 1.7628),
        ((0, -0.316, 0), (pi / 2, 0, 0), -2.8973, 2.8973),
        ((0.0825, 0, 0), (pi / 2, 0, 0), -3.0718, -0.0698),
        ((-0.0825, 0.384, 0), (-pi / 2, 0, 0), -2.8973, 2.8973),
        ((0, 0, 0), (pi / 2, 0, 0), -0.0175, 3.7525),
        ((0.088, 0, 0), (pi / 2, 0, 0), -2.8973, 2.8973),
    ],
    (0, 0, 0.107),
)
IIWA_14 = (
    [
        ((0, 0, 0.1575), (0, 0, 0), -2.967, 2.967),
        ((0, 0, 0.2025), (pi / 2, 0, pi), -2.094, 2.094),
        ((0, 0.2045, 0), (pi / 2, 0, pi), -2.967, 2.967),
        ((0, 0, 0.2155), (pi / 2, 0, 0), -2.094, 2.094),
        ((0, 0.1845, 0), (-pi / 2, pi, 0), -2.967, 2.967),
        ((0, 0, 0.2155), (pi / 2, 0, 0), -2.094, 2.094),
        ((0, 0.081, 0), (-pi / 2, pi, 0), -3.054, 3.054),
    ],
    (0, 0, 0.045),
)
PLANAR_10 = ([((0.0 if k == 0 else 0.1, 0, 0), (0, 0, 0), None, None) for k in range(10)], (0.1, 0, 0))


def arm_urdf(joints, tool):
    """The URDF of a chain link0 … tool."""

    def numbers(values):
        return " ".join(f"{value:.12g}" for value in values)

    parts = [f'<link name="link{k}"/>' for k in range(len(joints) + 1)] + ['<link name="tool"/>']
    for k, (xyz, rpy, lower, upper) in enumerate(joints):
        kind = "continuous" if lower is None else "revolute"
        limit = "" if lower is None else f'lower="{lower}" upper="{upper}" '
        parts.append(
            f'<joint name="joint{k + 1}" type="{kind}"><parent link="link{k}"/><child link="link{k + 1}"/>'
            f'<origin xyz="{numbers(xyz)}" rpy="{numbers(rpy)}"/><axis xyz="0 0 1"/>'
            f'<limit {limit}velocity="1" effort="1"/></joint>'
        )
    parts.append(
        f'<joint name="tool" type="fixed"><parent link="link{len(joints)}"/><child link="tool"/>'
        f'<origin xyz="{numbers(tool)}"/></joint>'
    )
    return f'<robot name="arm">{"".join(parts)}</robot>'
