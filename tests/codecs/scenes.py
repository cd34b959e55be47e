"""Scenes that a robot may see, made by numpy and the same every time: a street by a lidar, a map that grows."""

from __future__ import annotations

from functools import cache
from typing import Any

import av
import numpy as np
import numpy.typing as npt

from gr_ros2.codecs import video
from gr_ros2.codecs.messages import CAMERA_INFO, CLOUD, COMPRESSED_IMAGE, GRID, IMAGE, header_of, store, write

Array = npt.NDArray[Any]
_TYPES = store().types


def header(number: int = 0, frame_id: str = "camera") -> Any:
    """A stamp of 0.1 s times the number."""
    time = _TYPES["builtin_interfaces/msg/Time"](1_700_000_000 + number // 10, number % 10 * 100_000_000)
    return header_of(time, frame_id)


def street(number: int = 0, rings: int = 64, columns: int = 1800) -> Array:
    """x, y, z (m) and intensity of a lidar scan of a street: ground, houses, parked cars, poles; noise of 2 cm.

    :returns: shape (rings, columns, 4), float32; NaN where nothing was hit
    """
    rng = np.random.default_rng([7, number])
    fixed = np.random.default_rng(7)
    azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)
    elevation = np.radians(np.linspace(2.0, -24.8, rings))[:, None]
    east, north, up = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    height, shift = 1.73, 0.8 * number
    distance = np.where(up < 0, height / np.maximum(-up, 1e-6), np.inf)

    def nearer(found: Array, hits: Array) -> Array:
        return np.where(hits & (found > 0) & (found < distance), found, distance)

    with np.errstate(divide="ignore", invalid="ignore"):
        for side in (-9.0, 10.0):  # fronts of houses, with gaps between them
            far = side / np.broadcast_to(north, (rings, columns))
            along, top = far * east + shift, far * up + height
            distance = nearer(far, (top < 8) & (np.mod(along + side, 17.0) > 2.5))
        boxes = [(x, side * 4.2, 4.3, 1.8, 1.5) for x in np.arange(-60, 80, 6.5) for side in (-1, 1)]
        boxes += [(x, side * 6.5, 0.25, 0.25, 6.0) for x in np.arange(-60, 80, 11.0) for side in (-1, 1)]
        boxes += [(*fixed.uniform((-60, -8), (80, 8)), 0.6, 0.6, 1.75) for _ in range(25)]
        for place, y, long, wide, tall in boxes:
            x = place - shift
            if abs(x) < 3 and abs(y) < 3:
                continue
            near, far = np.full((rings, columns), 0.0), np.full((rings, columns), np.inf)
            for ray, low, high in (
                (east, x - long / 2, x + long / 2), (north, y - wide / 2, y + wide / 2), (up, -height, tall - height),
            ):  # fmt: skip
                one, other = low / ray, high / ray
                near, far = np.maximum(near, np.minimum(one, other)), np.minimum(far, np.maximum(one, other))
            distance = nearer(near, near < far)
        for x in np.arange(-60, 80, 5.0):  # trees and hedges: a beam goes somewhere into what it meets first
            for y, base, tall, radius in ((-7.2, 0.0, 1.2, 1.1), (7.6, 2.0, 6.0, 1.6), (-8.0, 2.5, 6.0, 1.5)):
                middle = (x - shift) * east + y * north + ((base + tall) / 2 - height) * up
                gap = (x - shift) ** 2 + y**2 + ((base + tall) / 2 - height) ** 2 - middle**2
                leaves = middle - np.sqrt(np.maximum(radius**2 - gap, 0)) * rng.uniform(-1, 1, distance.shape)
                distance = nearer(leaves, (gap < radius**2) & (rng.random(distance.shape) < 0.8))
    distance = distance + rng.normal(0, 0.02, distance.shape)
    distance[(distance > 100) | (rng.random(distance.shape) < 0.02)] = np.nan
    intensity = np.clip(np.exp(-distance / 40) + rng.normal(0, 0.05, distance.shape), 0, 1)
    return np.stack([distance * east, distance * north, distance * up, intensity], 2).astype(np.float32)


def cloud(
    points: Array,
    *,
    big: bool = False,
    layout: tuple[tuple[str, int, int], ...] = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 16, 7)),
    step: int = 24,
    row_padding: int = 0,
    number: int = 0,
) -> bytes:
    """A PointCloud2.

    :param points: shape (height, width, fields)
    :param layout: name, offset and type of each field
    """
    high, wide, _ = points.shape
    data = np.random.default_rng(1).integers(0, 256, (high, wide * step + row_padding), dtype=np.uint8)
    order = ">" if big else "<"
    kinds = {2: "u1", 4: "u2", 6: "u4", 7: "f4", 8: "f8"}
    for n, (_, offset, kind) in enumerate(layout if points.size else ()):
        view = np.ndarray((high, wide), order + kinds[kind], data, offset, (wide * step + row_padding, step))
        with np.errstate(invalid="ignore"):
            view[...] = points[:, :, n]
    field = _TYPES["sensor_msgs/msg/PointField"]
    return write(
        CLOUD,
        header=header(number, "lidar"),
        height=high,
        width=wide,
        fields=[field(name=name, offset=offset, datatype=kind, count=1) for name, offset, kind in layout],
        is_bigendian=big,
        point_step=step,
        row_step=wide * step + row_padding,
        data=data.ravel(),
        is_dense=False,
    )


def grid(
    cells: Array, number: int = 0, origin: tuple[float, float] = (-10.0, -10.0), resolution: float = 0.05
) -> bytes:
    """An OccupancyGrid."""
    types = _TYPES
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=origin[0], y=origin[1], z=0.0),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    made = header(number, "map")
    info = types["nav_msgs/msg/MapMetaData"](
        map_load_time=made.stamp, resolution=resolution, width=cells.shape[1], height=cells.shape[0], origin=pose
    )
    return write(GRID, header=made, info=info, data=cells.astype(np.int8).ravel())


def path(length: int, number: int = 0) -> bytes:
    """A Path of so many poses, each a step beyond the one before."""
    types, rng = _TYPES, np.random.default_rng(7)
    poses = []
    for n, (x, y) in enumerate(np.cumsum(rng.normal(0.1, 0.02, (length, 2)), 0)):
        pose = types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](x=x, y=y, z=0.0),
            orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        )
        poses.append(types["geometry_msgs/msg/PoseStamped"](header=header(n, "map"), pose=pose))
    return write("nav_msgs/msg/Path", header=header(number, "map"), poses=poses)


def exploring(steps: int, size: int = 600) -> list[bytes]:
    """Maps of a robot that explores rooms: cells of 5 cm, the laser sees 6 m, occupied cells flicker."""
    rng = np.random.default_rng(1)
    truth = np.zeros((size, size), np.int8)
    truth[::100], truth[:, ::150] = 100, 100
    for row in range(0, size, 100):
        for column in range(0, size, 150):
            truth[row, column + 60 : column + 80] = truth[row + 40 : row + 60, column] = 0
    for row, column in rng.integers(5, size - 15, (150, 2)):
        truth[row : row + rng.integers(2, 9), column : column + rng.integers(2, 9)] = 100
    known = np.full((size, size), -1, np.int8)
    y, x = np.mgrid[:size, :size]
    found = []
    for step in range(steps):
        turn = step / 120 * 2 * np.pi
        place = size / 2 + size / 3 * np.sin(turn), size / 2 + size / 3 * np.cos(turn) * np.cos(turn / 2)
        seen = ((y - place[0]) ** 2 + (x - place[1]) ** 2 < 120**2) & (rng.random((size, size)) < 0.8)
        known[seen] = truth[seen]
        known[seen & (truth == 100) & (rng.random((size, size)) < 0.02)] = 0
        found.append(grid(known, step))
    return found


@cache
def _walls() -> Array:
    """A large picture of textured surfaces with edges, float32 of shape (900, 1600, 3), 0..255."""
    rng = np.random.default_rng(3)
    made = np.zeros((900, 1600, 3), np.float32)
    for size in (100, 50, 25, 5):
        coarse = rng.normal(0, 9 + size / 5, (900 // size, 1600 // size, 3)).astype(np.float32)
        made += np.kron(coarse, np.ones((size, size, 1), np.float32)) * (0.4 if size == 5 else 1)
    made = made.mean(2, keepdims=True) + 0.5 * (made - made.mean(2, keepdims=True)) + 120
    for _ in range(60):
        top, left = rng.integers(0, 860), rng.integers(0, 1550)
        high, wide = rng.integers(10, 160), rng.integers(10, 160)
        made[top : top + high, left : left + wide] = (
            0.7 * rng.integers(0, 256, 3) + 0.3 * made[top : top + high, left : left + wide]
        )
    return made


def view(number: float, width: int = 640, height: int = 480) -> Array:
    """What a camera sees that pans and zooms over walls while something moves: uint8 RGB with noise of the sensor."""
    rng = np.random.default_rng([11, round(2 * number)])
    turn = number / 15
    zoom = 1.1 + 0.15 * np.sin(0.7 * turn)
    middle_x, middle_y = 800 + 330 * np.sin(0.5 * turn), 450 + 120 * np.sin(0.83 * turn)
    x = middle_x + (np.arange(width) - width / 2) * zoom * 640 / width
    y = middle_y + (np.arange(height) - height / 2) * zoom * 480 / height
    walls = _walls()
    left, top = x.astype(int), y.astype(int)
    right, down = (x - left).astype(np.float32)[None, :, None], (y - top).astype(np.float32)[:, None, None]
    upper = walls[top][:, left] * (1 - right) + walls[top][:, left + 1] * right
    lower = walls[top + 1][:, left] * (1 - right) + walls[top + 1][:, left + 1] * right
    seen = upper * (1 - down) + lower * down
    place = int((0.1 + 0.7 * (turn / 4 % 1)) * width)
    seen[height // 2 : height // 2 + height // 4, place : place + width // 8] = (200, 60, 40)
    return np.clip(seen + rng.normal(0, 2.5, seen.shape), 0, 255).astype(np.uint8)


def image(pixels: Array, encoding: str, number: int = 0, padding: int = 0, big: bool = False) -> bytes:
    """An Image whose rows have some bytes more than their pixels."""
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    padded = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    return write(
        IMAGE,
        header=header(number),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=int(big),
        step=padded.shape[1],
        data=padded.ravel(),
    )


def picture(pixels: Array, kind: str) -> av.VideoFrame:
    """RGB pixels as a picture of FFmpeg's pixel format ``kind``."""
    return video.from_rows(pixels.reshape(len(pixels), -1), pixels.shape[1], "rgb24").reformat(format=kind)


def compressed(data: bytes, label: str, number: int = 0) -> bytes:
    """A CompressedImage."""
    return write(COMPRESSED_IMAGE, header=header(number), format=label, data=np.frombuffer(data, np.uint8))


def room(number: int = 0, width: int = 640, height: int = 480) -> Array:
    """Depth of a room by a hand-held sensor, m, float32: walls, floor, boxes; 0 where a sensor sees none.

    The noise grows with the square of the distance, as that of sensors of structured light does (2.5 mm at 1 m), and
    steps of disparity are 1/8 pixel of 575; shadows lie left of edges, and far or slanted spots are missing.
    """
    rng = np.random.default_rng([13, number])
    turn = 0.02 * number
    u = (np.arange(width) - width / 2)[None, :] / (0.9 * width)
    v = (np.arange(height) - height / 2)[:, None] / (0.9 * width)
    x, z = np.cos(turn) * u + np.sin(turn), np.cos(turn) - np.sin(turn) * u
    here = 0.3 * np.sin(0.1 * number), 0.01 * number
    found = np.full((height, width), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for plane, offset, along in ((x, 1.7, 0), (x, -1.5, 0), (z, 3.2, 1)):
            far = (offset - here[along]) / np.broadcast_to(plane, found.shape)
            found = np.where((far > 0) & (far < found), far, found)
        for plane, offset in ((v, 0.9), (v, -1.6)):
            far = offset / np.broadcast_to(plane, found.shape)
            found = np.where((far > 0) & (far < found), far, found)
        boxes = ((-0.9, 0.9, 1.6, 0.7), (0.3, 0.9, 2.3, 0.8), (0.9, 0.3, 2.8, 0.5), (-0.2, 0.1, 1.2, 0.2))
        for left, bottom, place, size in boxes:
            far = np.broadcast_to((place - here[1]) / z, found.shape)
            across, down = far * x + here[0], far * v
            hits = (across > left) & (across < left + size) & (down < bottom) & (down > bottom - size) & (far > 0)
            bump = 0.03 * np.sin(9 * across) * np.cos(7 * down)
            found = np.where(hits & (far < found), far + bump, found)
    found = found + rng.normal(0, 0.0015, found.shape) * found**2
    disparity = np.rint(575 * 0.075 / found * 8) / 8
    found = 575 * 0.075 / disparity
    edges = np.abs(np.diff(found, axis=1, prepend=found[:, :1])) > 0.15
    for shift in range(1, 9):
        found[:, :-shift] = np.where(edges[:, shift:], 0, found[:, :-shift])
    blotches = np.kron(rng.random((-(-height // 12), -(-width // 12))), np.ones((12, 12)))[:height, :width]
    found[(blotches < 0.01) | (found > 6) | (found < 0.4)] = 0
    found[:, : width // 80] = 0
    return found.astype(np.float32)


def camera_info(width: int = 640, height: int = 480, number: int = 4) -> bytes:
    """What a camera says of itself."""
    roi = _TYPES["sensor_msgs/msg/RegionOfInterest"](x_offset=100, y_offset=50, height=200, width=300, do_rectify=True)
    return write(
        CAMERA_INFO,
        header=header(number),
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=np.array([0.1, -0.2, 0.001, 0.002, 0.0]),
        k=np.array([600.0, 0, 320, 0, 610, 239, 0, 0, 1]),
        r=np.eye(3).ravel(),
        p=np.array([590.0, 0, 321, -12, 0, 600, 240, 0, 0, 0, 1, 0]),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def scan(number: int = 0, beams: int = 360) -> bytes:
    """A LaserScan in whole millimetres; a tenth of its beams meet nothing."""
    rng = np.random.default_rng([3, number])
    far = np.rint(4000 + 2000 * np.sin(np.linspace(0, 20, beams)) + rng.normal(0, 5, beams))
    ranges = np.where(rng.random(beams) < 0.1, np.inf, far / 1000).astype(np.float32)
    limits = {"angle_min": -3.14, "angle_max": 3.14, "range_min": 0.1, "range_max": 12.0}
    times = {"angle_increment": 6.28 / beams, "time_increment": 0.0, "scan_time": 0.1}
    nothing = np.zeros(0, np.float32)
    return write(
        "sensor_msgs/msg/LaserScan", header=header(number), ranges=ranges, intensities=nothing, **limits, **times
    )
