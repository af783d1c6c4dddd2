#!/usr/bin/python3
"""Whether a calibration's picture has a circle about each ball, where the true arm shows it.

Usage: circles.py PICTURE.png PHANTOM.json TRUE-SCAN.json VIEW

TRUE-SCAN has the matrices that the projections were simulated with, PHANTOM is of circles. Nothing of the calibration is
read but its picture: of a ball that stands clear of the others, the ring of white pixels with the most of them is looked for
in the picture, and its centre is held against the ball's projection.
"""
import json
import math
import struct
import sys
import zlib

ANGLES = [2 * math.pi * k / 48 for k in range(48)]


def decode(data: bytes) -> list:
    """8 bit gray as rows of bytes."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, packed, width, height = 8, b"", 0, 0
    while at < len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        body = data[at + 8 : at + 8 + length]
        assert zlib.crc32(kind + body) == struct.unpack(">I", data[at + 8 + length : at + 12 + length])[0]
        if kind == b"IHDR":
            width, height, depth, colours = struct.unpack(">IIBB", body[:10])
            assert (depth, colours) == (8, 0), "8 bit gray"
        packed += body if kind == b"IDAT" else b""
        at += 12 + length
    lines, rows, above = zlib.decompress(packed), [], bytes(width)
    for i in range(height):
        method, line = lines[i * (width + 1)], bytearray(lines[i * (width + 1) + 1 : (i + 1) * (width + 1)])
        for x in range(width):
            left, up, corner = line[x - 1] if x else 0, above[x], above[x - 1] if x else 0
            nearest = min((left, up, corner), key=lambda value: abs(left + up - corner - value))
            line[x] = (line[x] + (0, left, up, (left + up) // 2, nearest)[method]) % 256
        rows.append(bytes(line))
        above = rows[-1]
    return rows


def balls_of(phantom: dict) -> list:
    """Places in mm of two circles."""
    places = []
    for circle in range(2):
        for k in range(phantom["balls"]):
            angle = math.radians(phantom["first_angle_deg"] + circle * phantom["shift_deg"] + 360 * k / phantom["balls"])
            places.append((phantom["diameter_mm"] / 2 * math.cos(angle), phantom["diameter_mm"] / 2 * math.sin(angle),
                           (circle - 0.5) * phantom["distance_mm"]))
    return places


def project(matrix: list, place: tuple) -> tuple:
    column, row, depth = (sum(matrix[4 * i + a] * (*place, 1)[a] for a in range(4)) for i in range(3))
    return column / depth, row / depth


def share(rows: list, column: float, row: float, radius: float) -> float:
    """Of a circle, how much is white."""
    points = [(round(column + radius * math.cos(a)), round(row + radius * math.sin(a))) for a in ANGLES]
    return sum(0 <= y < len(rows) and 0 <= x < len(rows[0]) and rows[y][x] == 255 for x, y in points) / len(points)


def main() -> None:
    picture, phantom, scan, view = sys.argv[1:5]
    rows = decode(open(picture, "rb").read())
    phantom, scan = (json.load(open(name, encoding="utf-8")) for name in (phantom, scan))
    matrix, places = scan["geometry"]["matrices"][int(view)], balls_of(phantom)
    pixels = [project(matrix, place) for place in places]
    assert (len(rows), len(rows[0])) == (scan["detector"]["rows"], scan["detector"]["columns"]), "a pixel for each of the detector's"
    checked = 0
    for i, (column, row) in enumerate(pixels):
        ball = phantom["ball_mm"]
        radius = max(math.dist((column, row), project(matrix, (*places[i][:2], places[i][2] + side * ball / 2))) for side in (-1, 1))
        apart = min(math.dist(pixels[i], other) for j, other in enumerate(pixels) if j != i)
        if apart < 3 * radius or not 5 * radius < column < len(rows[0]) - 5 * radius or not 5 * radius < row < len(rows) - 5 * radius:
            continue
        best = max((share(rows, column + 0.5 * x, row + 0.5 * y, radius * (1.2 + 0.1 * r)), x, y, radius * (1.2 + 0.1 * r))
                   for x in range(-8, 9) for y in range(-8, 9) for r in range(20))
        middle = rows[round(row)][round(column)]
        around = sum(rows[round(row + best[3] * 1.6 * math.sin(a))][round(column + best[3] * 1.6 * math.cos(a))] for a in ANGLES) / len(ANGLES)
        assert best[0] > 0.75, f"a circle about ball {i}, the best is {best}"
        assert math.hypot(best[1], best[2]) <= 2, f"its centre within a pixel of where ball {i} is, got {best}"
        assert middle > around + 20, f"ball {i} brighter than what is around it: {middle}, {around}"
        checked += 1
    assert checked >= 3, f"balls that stand clear: {checked} of {len(pixels)}"


main()
