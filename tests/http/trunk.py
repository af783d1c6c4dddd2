#!/usr/bin/env python3
"""A trunk of 500 mm under a panel that covers +-84 mm of the axis, and the means of a volume's slices beside it.

Usage: trunk.py make DIRECTORY | trunk.py grid HALF_MM SPACING | trunk.py slices VOLUME HALF_MM SPACING

make: exact line integrals of elliptic cylinders and ellipsoids, as a scan directory. grid: the job's "grid", from -HALF_MM
to HALF_MM along z, all of the body across. slices: {"seen": HU, "any": HU}, the largest error of a slice's mean over the
body, of the slices that all views see, and of all.
"""
import json
import os
import sys
from typing import Any, Dict, List, Tuple

import numpy as np

from metal import Part, chord, within

WATER = 0.0192
VIEWS, COLUMNS, ROWS, PIXEL, NEAR, FAR = 72, 56, 44, 6.8, 620.0, 1100.0
TRUNK = [
    Part(True, (100, 75, 250), (0, 0, 0), 0, 1),
    Part(True, (18, 16, 250), (0, -45, 0), 0, 0.6),
    Part(True, (6, 6, 250), (0, -45, 0), 0, -0.3),
    Part(False, (30, 25, 60), (45, 15, 60), 0, -0.6),
    Part(False, (25, 30, 50), (-45, 20, -70), 0.3, 0.2),
    Part(False, (8, 8, 8), (60, -10, 78), 0, 0.8),
    Part(False, (7, 9, 8), (10, 40, -60), 0, -0.5),
]
SEEN = ROWS * PIXEL / 2 / FAR * (NEAR - 100)  # mm along z, by all views, of what is 100 mm off the axis


def make(directory: str) -> None:
    columns = (np.arange(COLUMNS) - (COLUMNS - 1) / 2) * PIXEL
    rows = (np.arange(ROWS) - (ROWS - 1) / 2) * PIXEL
    views = np.zeros((VIEWS, ROWS, COLUMNS))
    for view, angle in enumerate(np.arange(VIEWS) * 2 * np.pi / VIEWS):
        out, across = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
        rays = columns[None, :, None] * across + rows[:, None, None] * np.array([0, 0, 1]) - FAR * out
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        views[view] = sum(WATER * part.density * chord(part, NEAR * out, rays) for part in TRUNK)
    document = {
        "name": "trunk",
        "detector": {"columns": COLUMNS, "rows": ROWS, "pixel_mm": [PIXEL, PIXEL]},
        "projections": {"count": VIEWS, "sample": "float32", "quantity": "line_integral"},
        "geometry": {
            "kind": "circular",
            "source_to_isocentre_mm": NEAR,
            "source_to_detector_mm": FAR,
            "angle_step_deg": 360 / VIEWS,
        },
    }
    os.makedirs(directory)
    views.astype("<f4").tofile(os.path.join(directory, "projections.raw"))
    with open(os.path.join(directory, "scan.json"), "w", encoding="utf-8") as file:
        json.dump(document, file)


def size_of(half: float, spacing: float) -> Tuple[int, int, int]:
    across = 2 * int(np.ceil(110 / spacing))
    return across, across, round(2 * half / spacing)


def slices(volume: str, half: float, spacing: float) -> Dict[str, float]:
    size = size_of(half, spacing)
    voxels = np.fromfile(volume, "<f4").reshape(size[::-1])
    axes = [(np.arange(count) - (count - 1) / 2) * spacing for count in size]
    truth = np.zeros(size[::-1])
    inner = (np.arange(3) - 1) / 3 * spacing
    for shift in np.stack(np.meshgrid(inner, inner, inner), -1).reshape(-1, 3):
        places = np.stack(np.meshgrid(*axes[::-1], indexing="ij")[::-1], -1) + shift
        truth += sum(WATER * part.density * within(part, places, 0) for part in TRUNK) / 27
    body = truth > WATER / 2
    errors = [abs(1000 / WATER * float((voxels[k] - truth[k])[body[k]].mean())) for k in range(size[2])]
    seen = [error for error, z in zip(errors, axes[2]) if abs(z) + spacing / 2 < SEEN]
    return {"seen": max(seen), "any": max(errors)}


def main(arguments: List[str]) -> None:
    numbers = [float(text) for text in arguments[-2:]] if arguments[:1] != ["make"] else []
    result: Dict[str, Any]
    if arguments[:1] == ["make"] and len(arguments) == 2:
        make(arguments[1])
        return
    if arguments[:1] == ["grid"] and len(arguments) == 3:
        result = {"size": size_of(*numbers), "spacing_mm": [numbers[1]] * 3}
    elif arguments[:1] == ["slices"] and len(arguments) == 4:
        result = slices(arguments[1], *numbers)
    else:
        sys.exit(__doc__)
    print(json.dumps(result))


if __name__ == "__main__":
    main(sys.argv[1:])
