"""Faces and circles as frames for robots' software: URDF, xacro, messages of tf2, launch files that publish them."""

from collections.abc import Callable
from xml.sax.saxutils import quoteattr

from stcal.io.poses.static import (
    Static,
    fixed_joint,
    messages,
    ros1_launch,
    ros2_launch,
)
from stcal.sfm.interop.export.content import Content

PLATE_M = 1e-4
"""Height of the cylinders that show circles; their outer sides lie in the faces' planes."""
MM_M = 1e-3


def urdf(content: Content) -> str:
    """A ``robot`` of links without mass: target, faces with their circles to look at, circles."""
    head = ['<?xml version="1.0"?>', *_comments(content), f"<robot name={quoteattr(content.root)}>"]
    return "\n".join([*head, f"<link name={quoteattr(content.root)}/>", *_body(content, str), "</robot>\n"])


def xacro(content: Content) -> str:
    """A macro of the same, to hold the target anywhere and more than once: ``prefix``, ``parent``, ``origin``."""

    def prefixed(name: str) -> str:
        return "${prefix}" + _escaped(name)

    macro = "".join(c if c.isalnum() else "_" for c in content.root)
    root = prefixed(content.root)
    lines = ['<?xml version="1.0"?>', *map(_escaped, _comments(content))]
    lines += ['<robot xmlns:xacro="http://www.ros.org/wiki/xacro">']
    lines += [f"<xacro:macro name={quoteattr(macro)} params=\"prefix:='' parent *origin\">"]
    lines += [f"<link name={quoteattr(root)}/>"]
    lines += [f'<joint name={quoteattr(root + "_mount")} type="fixed">', '  <parent link="${parent}"/>']
    lines += [f"  <child link={quoteattr(root)}/>", '  <xacro:insert_block name="origin"/>', "</joint>"]
    return "\n".join([*lines, *_body(content, prefixed), "</xacro:macro>", "</robot>\n"])


def tf2(content: Content) -> str:
    """``geometry_msgs/TransformStamped``, a document for each frame; metres."""
    return "".join(f"# {line}\n" for line in content.said()) + messages(content.statics())


def launch_ros2(content: Content) -> str:
    """A launch file of ROS 2 that publishes the frames."""
    return ros2_launch(content.statics(), content.said())


def launch_ros1(content: Content) -> str:
    """A launch file of ROS 1 that publishes the frames."""
    return ros1_launch(content.statics(), [line.replace("--", "- -") for line in content.said()])


def _body(content: Content, named: Callable[[str], str]) -> list[str]:
    links = []
    for face, pose in content.faces.items():
        links.append(f"<link name={quoteattr(named(content.face_frame(face)))}>")
        red, green, blue = (f"{v / 255:.4g}" for v in content.rgb[face])
        for circle in content.of_face(face):
            x, y, z = (float(v) * MM_M for v in pose.inverse() @ circle.xyz_mm)
            links += [
                "  <visual>",
                f'    <origin xyz="{x!r} {y!r} {z - PLATE_M / 2!r}" rpy="0 0 0"/>',
                f'    <geometry><cylinder radius="{circle.radius_mm * MM_M!r}" length="{PLATE_M!r}"/></geometry>',
                f"    <material name={quoteattr(named(f'{content.face_frame(face)}_colour'))}>"
                f'<color rgba="{red} {green} {blue} 1"/></material>',
                "  </visual>",
            ]
        links.append("</link>")
        links += [f"<link name={quoteattr(named(content.circle_frame(c.label)))}/>" for c in content.of_face(face)]
    joints = [fixed_joint(Static(named(each.parent), named(each.child), each.pose)) for each in content.statics()]
    return [*links, *(joint.rstrip("\n") for joint in joints)]


def _comments(content: Content) -> list[str]:
    """In XML; ``--`` may not stand in them."""
    return [f"<!-- {line.replace('--', '- -')} -->" for line in content.said()]


def _escaped(text: str) -> str:
    """Where xacro would put a value."""
    return text.replace("$(", "$$(").replace("${", "$${")
