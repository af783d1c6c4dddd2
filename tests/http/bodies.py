#!/usr/bin/env python3
"""Scans of a head, a wrist and a skull from exact integrals, and what their volumes show.

Usage: bodies.py make BODY DIRECTORY   a scan directory of line integrals, with the Poisson noise of so many photons in air
       bodies.py grid BODY             the volumes' grid, as a job has it
       bodies.py rmse BODY VOLUME ...  JSON: of each volume the root mean square error in HU, over what is denser than half of water in the
                                       middle half of the slices
       bodies.py rings VOLUME          JSON: the mean errors in HU of the brain within the skull, which is all that the detector
                                       sees whole: "centre" (to .25 of the field of view's radius), "middle" (.45 to .6), "rim"
                                       (.88 to .97)

Volumes are files of float32 voxels, 1/mm (format=raw). The skull is that of "a skull" in tests/unit/test_recon.c, wider and
higher than the field of view of 129 mm; head and wrist end within the grid.
"""
import json
import os
import sys
from typing import Dict, List, NamedTuple, Tuple

import numpy as np

from metal import Part, chord, within

WATER, NEAR, FAR = 0.0192, 620.0, 1100.0
FIELD = 129.0  # mm: what all views of the skull see


class Scan(NamedTuple):
    """Pixels and voxels in mm, the pixels on the detector."""

    views: int
    columns: int
    rows: int
    pixel: float
    photons: float
    size: Tuple[int, int, int]
    spacing: float


def tube(x: float, y: float, a: float, b: float, half: float, density: float, turn: float = 0) -> Part:
    return Part(True, (a, b, half), (x, y, 0), turn, density)


def lumps(count: int, place: Tuple[float, float, float, float], radii: Tuple[float, float], half: float, hu: float) -> List[Part]:
    """Ellipsoids at random in an ellipse, brighter and darker."""
    random, parts = np.random.default_rng(count), []
    for _ in range(count):
        turn, out = random.uniform(0, 2 * np.pi), np.sqrt(random.uniform())
        centre = (place[0] + out * place[2] * np.cos(turn), place[1] + out * place[3] * np.sin(turn), random.uniform(-half, half))
        a, b, c = random.uniform(*radii, 3)
        parts.append(Part(False, (a, b, c), centre, turn, float(random.uniform(0.2, 1) * random.choice((-1, 1)) * hu / 1000)))
    return parts


def bone(x: float, y: float, a: float, b: float, turn: float, half: float) -> List[Part]:
    return [tube(x, y, a, b, half, 1.0, turn), tube(x, y, a - 1.3, b - 1.3, half, -0.75, turn)]


BODIES: Dict[str, List[Part]] = {
    "head": [tube(0, 0, 74, 93, 5, 1), tube(0, 0, 70, 89, 5, 0.85), tube(0, 0, 64, 83, 5, -0.815), tube(-27, -34, 9, 9, 5, 0.3)]
    + [tube(side * 10, 12, 7, 24, 5, -0.028, -side * 0.25) for side in (-1, 1)]
    + lumps(12, (0, 0, 50, 68), (3, 10), 4, 100),
    "wrist": [tube(0, 0, 30, 21, 3.5, 1.04), tube(1, 13, 3, 3, 3.5, 0.3)]
    + bone(-12, 2, 9, 7, 0.2, 3.5)
    + bone(11, -2, 7, 6, -0.3, 3.5)
    + lumps(16, (-12, 2, 6.5, 4.5), (0.5, 1.2), 3, 220)
    + lumps(12, (11, -2, 5, 4), (0.5, 1.2), 3, 220),
    "skull": [tube(0, 0, 75, 93, 500, 1.03), tube(0, 0, 72, 90, 500, 1.47), tube(0, 0, 65, 83, 500, -1.47)],
}
SCANS = {
    "head": Scan(200, 204, 10, 1.77, 3e3, (104, 128, 8), 1.5),
    "wrist": Scan(200, 112, 18, 1.06, 3e3, (88, 62, 12), 0.7),
    "skull": Scan(120, 96, 12, 2 * FAR * np.tan(np.arcsin(FIELD / 2 / NEAR)) / 96, 0, (43, 43, 3), 3.0),
}


def make(body: str, directory: str) -> None:
    scan = SCANS[body]
    columns, rows = ((np.arange(count) - (count - 1) / 2) * scan.pixel for count in (scan.columns, scan.rows))
    views = np.zeros((scan.views, scan.rows, scan.columns))
    for view, angle in enumerate(np.arange(scan.views) * 2 * np.pi / scan.views):
        out, across = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
        rays = columns[None, :, None] * across + rows[:, None, None] * np.array([0, 0, 1]) - FAR * out
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        views[view] = sum(WATER * part.density * chord(part, NEAR * out, rays) for part in BODIES[body])
    if scan.photons > 0:
        counts = np.random.default_rng(5).poisson(scan.photons * np.exp(-views))
        views = -np.log(np.maximum(counts, 0.5) / scan.photons)
    document = {
        "name": body,
        "detector": {"columns": scan.columns, "rows": scan.rows, "pixel_mm": [scan.pixel] * 2},
        "projections": {"count": scan.views, "sample": "float32", "quantity": "line_integral"},
        "geometry": {
            "kind": "circular",
            "source_to_isocentre_mm": NEAR,
            "source_to_detector_mm": FAR,
            "angle_step_deg": 360 / scan.views,
        },
    }
    os.makedirs(directory)
    views.astype("<f4").tofile(os.path.join(directory, "projections.raw"))
    with open(os.path.join(directory, "scan.json"), "w", encoding="utf-8") as file:
        json.dump(document, file)


def load(body: str, volume: str) -> np.ndarray:
    return np.fromfile(volume, "<f4").reshape(SCANS[body].size[::-1]) / WATER


def places(body: str) -> np.ndarray:
    """[z][y][x][3], mm"""
    scan = SCANS[body]
    axes = [(np.arange(count) - (count - 1) / 2) * scan.spacing for count in scan.size]
    return np.stack(np.meshgrid(*axes[::-1], indexing="ij")[::-1], -1)


def rmse(body: str, volumes: List[str]) -> List[float]:
    inner, slices = (np.arange(3) - 1) / 3 * SCANS[body].spacing, SCANS[body].size[2]
    middle = slice(slices // 4, slices - slices // 4)
    at = places(body)[middle]
    truth = np.zeros(at.shape[:-1])
    for shift in np.stack(np.meshgrid(inner, inner, inner), -1).reshape(-1, 3):
        truth += sum(part.density * within(part, at + shift, 0) for part in BODIES[body]) / 27
    inside = truth > 0.5
    return [float(1000 * np.sqrt(((load(body, volume)[middle] - truth)[inside] ** 2).mean())) for volume in volumes]


def rings(volume: str) -> Dict[str, float]:
    more = 1000 * (load("skull", volume) - 1.03)
    radius = np.hypot(*np.moveaxis(places("skull")[..., :2], -1, 0)) / (FIELD / 2)
    parts = {"centre": (0, 0.25), "middle": (0.45, 0.6), "rim": (0.88, 0.97)}
    return {name: float(more[(radius >= first) & (radius <= last)].mean()) for name, (first, last) in parts.items()}


def main(arguments: List[str]) -> None:
    what, *rest = arguments or [""]
    if what == "make" and len(rest) == 2:
        make(*rest)
    elif what == "grid" and len(rest) == 1:
        print(json.dumps({"size": SCANS[rest[0]].size, "spacing_mm": [SCANS[rest[0]].spacing] * 3}))
    elif what == "rmse" and len(rest) > 1:
        print(json.dumps(rmse(rest[0], rest[1:])))
    elif what == "rings" and len(rest) == 1:
        print(json.dumps(rings(rest[0])))
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
