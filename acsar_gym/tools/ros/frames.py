"""Transforms between frames of ROS."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from acsar_gym.errors import LidarError, show_value

Translation = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Transform(NamedTuple):
    """Where a frame is, as geometry_msgs/TransformStamped says."""

    parent: str
    """The frame in which it is."""
    translation: Translation
    """x, y, z [m]."""
    rotation: Quaternion
    """x, y, z, w."""


def find_transform(
    transforms: Mapping[str, Transform], frame: str, base: str, source: str = "scan"
) -> tuple[Translation, Quaternion]:
    """Find where a frame is in another one, over those between them.

    Args:
        transforms: of /tf_static, by the names of their frames.
        frame: the scanner's, as the header of its messages says.
        base: the robot's.
        source: what messages call the scanner.

    Returns:
        Translation [m] and quaternion, for `find_mount`.

    Raises:
        LidarError: no transforms connect the two.
    """
    chains = [[*_find_parents(transforms, name)] for name in (frame, base)]
    names = [{name.lstrip("/"): place for place, (name, _, _) in enumerate(c)} for c in chains]
    common = next((name for name in names[0] if name in names[1]), None)
    if common is None:
        raise LidarError(
            f"{source}: nothing on /tf_static says where its frame {show_value(frame)} is in "
            f"{show_value(base)}",
            "publish it, such as by robot_state_publisher, or set base_frame of the robot's file",
        )
    (_, at, turn), (_, from_base, base_turn) = (
        chain[places[common]] for chain, places in zip(chains, names, strict=True)
    )
    back = (-base_turn[0], -base_turn[1], -base_turn[2], base_turn[3])
    apart = (at[0] - from_base[0], at[1] - from_base[1], at[2] - from_base[2])
    return _rotate(back, apart), _multiply(back, turn)


def _find_parents(
    transforms: Mapping[str, Transform], name: str
) -> Iterator[tuple[str, Translation, Quaternion]]:
    """Yield a frame, then its parents, each with where the first one is in it."""
    by_name = {child.lstrip("/"): transform for child, transform in transforms.items()}
    at, turn = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    for _ in range(len(by_name) + 1):  # those of a circle end, too
        yield name, at, turn
        transform = by_name.get(name.lstrip("/"))
        if transform is None:
            return
        x, y, z = _rotate(transform.rotation, at)
        dx, dy, dz = transform.translation
        at, turn = (x + dx, y + dy, z + dz), _multiply(transform.rotation, turn)
        name = transform.parent


def _multiply(first: Quaternion, second: Quaternion) -> Quaternion:
    """The rotation by `second`, then by `first`."""
    a, b, c, d = first
    x, y, z, w = second
    return (
        d * x + a * w + b * z - c * y,
        d * y - a * z + b * w + c * x,
        d * z + a * y - b * x + c * w,
        d * w - a * x - b * y - c * z,
    )


def _rotate(rotation: Quaternion, place: Translation) -> Translation:
    x, y, z, w = rotation
    turned = _multiply(_multiply(rotation, (*place, 0.0)), (-x, -y, -z, w))
    return turned[0], turned[1], turned[2]
