"""Random robots as URDF text: serial chains of every joint type, with rotated frames and skew axes."""

from __future__ import annotations

import numpy as np


def vector(values) -> str:
    return " ".join(f"{value:.12g}" for value in values)


def random_urdf(rng: np.random.Generator, joints: int = 6, *, branches: bool = False, mimic: bool = False) -> str:
    lines = ['<robot name="random">', '<link name="link_0"/>']
    for index in range(1, joints + 1):
        kind = rng.choice(["revolute", "continuous", "prismatic", "fixed"], p=[0.4, 0.3, 0.2, 0.1])
        kind = "revolute" if index == 1 else kind
        lines.append(joint(rng, f"joint_{index}", kind, f"link_{index - 1}", f"link_{index}"))
        if branches and index % 2 == 0:
            lines.append(joint(rng, f"side_{index}", "revolute", f"link_{index}", f"finger_{index}"))
    if mimic:
        follower = '<mimic joint="joint_1" multiplier="-0.7" offset="0.2"/>'
        lines.append(joint(rng, "follower", "revolute", f"link_{joints}", f"link_{joints + 1}", follower))
        joints += 1
    lines.append(joint(rng, "tool_joint", "fixed", f"link_{joints}", "tool"))
    return "\n".join([*lines, "</robot>"])


def joint(rng, name: str, kind: str, parent: str, child: str, extra: str = "") -> str:
    axis = rng.normal(size=3)
    origin = f'<origin xyz="{vector(rng.uniform(-0.4, 0.4, 3))}" rpy="{vector(rng.uniform(-3, 3, 3))}"/>'
    limit = '<limit lower="-2.5" upper="2.2" effort="1" velocity="1.5"/>' if kind in ("revolute", "prismatic") else ""
    return (
        f'<link name="{child}"/><joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'{origin}<axis xyz="{vector(axis / np.linalg.norm(axis))}"/>{limit}{extra}</joint>'
    )


BOX_ARM = """<robot name="box_arm">
  <link name="base">
    <collision><origin xyz="0 0 0.05"/><geometry><box size="0.2 0.2 0.1"/></geometry></collision>
  </link>
  <link name="upper">
    <collision><origin xyz="0 0 0.2"/><geometry><cylinder radius="0.05" length="0.3"/></geometry></collision>
  </link>
  <link name="fore">
    <collision><origin xyz="0 0 0.15"/><geometry><box size="0.06 0.06 0.3"/></geometry></collision>
  </link>
  <link name="hand">
    <collision><origin xyz="0 0 0.06"/><geometry><sphere radius="0.05"/></geometry></collision>
  </link>
  <link name="tip"/>
  <joint name="turn" type="continuous"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 0 1"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/>
    <origin xyz="0 0 0.4"/><axis xyz="0 1 0"/><limit lower="-2.9" upper="2.9" effort="1" velocity="1"/></joint>
  <joint name="wrist" type="revolute"><parent link="fore"/><child link="hand"/>
    <origin xyz="0 0 0.33"/><axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" effort="1" velocity="1"/></joint>
  <joint name="end" type="fixed"><parent link="hand"/><child link="tip"/><origin xyz="0 0 0.1"/></joint>
</robot>
"""
