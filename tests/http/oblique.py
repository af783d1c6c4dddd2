#!/usr/bin/python3
"""Slices at any angle against a resampling of the volume by numpy.

Usage: oblique.py URL VOLUME-PATH RAW NX,NY,NZ SPACING ORIGIN WINDOW LEVEL MU_WATER   (SPACING, ORIGIN: x,y,z in mm)

Asks for planes and slabs in many directions, and holds every pixel against the voxels in RAW (float32, 1/mm): at most
one gray level off, for rounding.
"""
import struct
import sys
import urllib.parse
import urllib.request
import zlib
from typing import Tuple

import numpy as np


def read_png(data: bytes) -> np.ndarray:
    """8-bit gray, no interlace."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, packed, width, height = 8, b"", 0, 0
    while at < len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        body = data[at + 8 : at + 8 + length]
        if kind == b"IHDR":
            width, height, depth, colour = struct.unpack(">IIBB", body[:10])
            assert (depth, colour) == (8, 0)
        elif kind == b"IDAT":
            packed += body
        at += 12 + length
    rows = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(height, width + 1)
    picture = np.zeros((height, width), np.uint8)
    for i, row in enumerate(rows):
        if row[0] == 1:
            picture[i] = np.cumsum(row[1:], dtype=np.uint64) & 255
        else:
            assert row[0] == 0, f"filter {row[0]}"
            picture[i] = row[1:]
    return picture


class Volume:
    def __init__(self, path: str, size: np.ndarray, spacing: np.ndarray, origin: np.ndarray) -> None:
        self.size, self.spacing, self.origin = size, spacing, origin
        self.voxels = np.fromfile(path, "<f4").reshape(size[::-1]).astype(float)

    def at(self, points: np.ndarray) -> Tuple[np.ndarray, np.ndarray]:
        """Values at points [..., 3] in mm: sums of tents about the voxels' centres; and which lie within the volume."""
        index = (points - self.origin) / self.spacing
        within = np.all((index >= -0.5 - 1e-6) & (index <= self.size - 0.5 + 1e-6), axis=-1)
        index = np.clip(index, 0, self.size - 1)
        value = np.zeros(index.shape[:-1])
        base = np.floor(index).astype(int)
        for corner in range(8):
            at = base + [corner & 1, corner >> 1 & 1, corner >> 2]
            weight = np.prod(np.maximum(1 - np.abs(index - at), 0), axis=-1)
            x, y, z = np.moveaxis(np.minimum(at, self.size - 1), -1, 0)
            value += weight * self.voxels[z, y, x]
        return value, within


def expected(volume: Volume, normal, up, center, size, spacing, thickness, mode, gray) -> np.ndarray:
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    right = np.cross(up, normal)
    right /= np.linalg.norm(right)
    down = np.cross(right, normal)
    layers = 1
    if thickness > 0:
        layers = max(1, int(np.ceil(thickness * np.sqrt(np.sum((normal / volume.spacing) ** 2)) - 1e-9)))
    column = (np.arange(size[0]) - (size[0] - 1) / 2) * spacing[0]
    row = (np.arange(size[1]) - (size[1] - 1) / 2) * spacing[1]
    values, inside = [], []
    for layer in range(layers):
        depth = ((layer + 0.5) / layers - 0.5) * thickness
        points = np.asarray(center) + depth * normal + column[None, :, None] * right + row[:, None, None] * down
        value, within = volume.at(points)
        values.append(value)
        inside.append(within)
    values, inside = np.array(values), np.array(inside)
    if mode == "mean":
        value = np.where(inside, values, 0).sum(0) / np.maximum(inside.sum(0), 1)
    elif mode == "max":
        value = np.where(inside, values, -np.inf).max(0)
    else:
        value = np.where(inside, values, np.inf).min(0)
    return np.where(inside.any(0), gray(np.where(inside.any(0), value, 0)), 0)


def main() -> int:
    url, path, raw = sys.argv[1:4]
    size, spacing, origin = (np.array(list(map(float, text.split(",")))) for text in sys.argv[4:7])
    window, level, water = map(float, sys.argv[7:10])
    size = size.astype(int)
    volume = Volume(raw, size, spacing, origin)
    black, white = (water * (1 + (level + half * window / 2) / 1000) for half in (-1, 1))
    gray = lambda value: np.floor(np.clip((value - black) / (white - black) * 255, 0, 255) + 0.5)
    middle = origin + (size - 1) * spacing / 2
    failed = pictures = plain = 0

    def check(query, **how) -> None:
        nonlocal failed, pictures, plain
        query = {**query, "window": f"{window:g}", "level": f"{level:g}"}
        text = urllib.parse.urlencode(query, safe=",")
        with urllib.request.urlopen(f"{url}{path}/slice?{text}") as reply:
            got = read_png(reply.read())
        wanted = expected(volume, gray=gray, **how)
        pictures += 1
        if got.shape != wanted.shape:
            print(f"{text}: {got.shape}, expected {wanted.shape}")
            failed += 1
            return
        worst = np.abs(got - wanted)
        # The border of the volume may fall on either side of a sample.
        plain += np.ptp(wanted) < 20
        if np.count_nonzero(worst > 1) > 0.002 * worst.size:
            print(f"{text}: {np.count_nonzero(worst > 1)} of {worst.size} pixels differ, by {worst.max()} at most")
            failed += 1

    listed = lambda numbers: ",".join(f"{number:.9g}" for number in numbers)
    generator = np.random.default_rng(7)
    ball = (12, -9, 10)  # its middle, mm
    ups = {"x": (0, 0, 1), "y": (0, 0, 1), "z": (0, -1, 0)}
    normals = {"x": (1, 0, 0), "y": (0, -1, 0), "z": (0, 0, -1)}
    # Along the axes a slab is that of a plane seen as planes across the axis are.
    for axis, (across, columns, rows) in {"x": (0, 1, 2), "y": (1, 0, 2), "z": (2, 0, 1)}.items():
        for thickness, mode in ((0, "mean"), (7.5, "mean"), (20, "max"), (12, "min")):
            center = middle.copy()
            index = int(round((ball[across] - origin[across]) / spacing[across])) + 1
            center[across] = origin[across] + index * spacing[across]
            slab = {"thickness": thickness, "mode": mode} if thickness else {}
            check({"axis": axis, "index": index, **slab}, normal=normals[axis], up=ups[axis], center=center,
                  size=size[[columns, rows]], spacing=spacing[[columns, rows]], thickness=thickness, mode=mode)
    for turn in range(12):
        normal, up = generator.normal(size=3), generator.normal(size=3)
        center = np.array(ball) + generator.uniform(-8, 8, 3)
        pixels, pixel = generator.integers(20, 70, 2), generator.uniform(0.7, 3)
        thickness, mode = ((0, "mean"), (6, "mean"), (25, "max"), (11, "min"))[turn % 4]
        slab = {"thickness": thickness, "mode": mode} if thickness else {}
        check({"normal": listed(normal), "up": listed(up), "center": listed(center), "size": listed(pixels),
               "spacing": f"{pixel:.9g}", **slab}, normal=normal, up=up, center=center, size=pixels,
              spacing=(pixel, pixel), thickness=thickness, mode=mode)
    print(f"{pictures} pictures, {failed} wrong, {plain} of one gray")
    return int(failed > 0 or plain > 2)


if __name__ == "__main__":
    sys.exit(main())
