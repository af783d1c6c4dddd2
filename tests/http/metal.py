#!/usr/bin/python3
"""Scans of a body with metal from exact integrals, and what their volumes show beside the metal.

Usage: metal.py make CASE DIR           a scan directory: raw counts of PHOTONS in air; CASE clean: line integrals of the
                                        body alone, without noise
       metal.py grid                    the volumes' grid, as a job has it; SIZE in the environment: its voxels, "92,76,30"
       metal.py beside CASE CLEAN VOLUME  JSON: root mean square and mean of bone in HU, 3 to 10 mm from the metal, against
                                        the volume CLEAN of the body alone; and the part of the metal's mass that is there
       metal.py dark DIR                how many samples have no counts

Volumes are files whose last bytes are float32 voxels, 1/mm (format=raw).

The body is of water, with an air bubble and a vertebra of bone; attenuations are in units of water's.
"""
import json
import os
import sys
from typing import Any, Dict, List, NamedTuple, Tuple

import numpy as np

WATER = 0.0192
PHOTONS = 4e4
VIEWS, COLUMNS, ROWS, PIXEL, NEAR, FAR = 120, 128, 48, 2.4, 620.0, 1100.0
SIZE, SPACING = tuple(int(count) for count in os.environ.get("SIZE", "92,76,30").split(",")), 1.5


class Part(NamedTuple):
    """An ellipsoid, or an elliptic cylinder along z of half the length axes[2]; turned about z by `turn` radians."""

    cylinder: bool
    axes: Tuple[float, float, float]
    centre: Tuple[float, float, float]
    turn: float
    density: float


BONE = Part(True, (15, 12, 13), (0, -16, 0), 0, 1.2)
BODY = [Part(True, (60, 48, 20), (0, 0, 0), 0, 1), Part(False, (9, 7, 9), (14, 22, 0), 0.3, -1), BONE]


def screws(aside: float, behind: float, turn: float) -> List[Part]:
    """Two above two others, towards each other in bone; of 17000 HU."""
    return [Part(False, (17, 2.5, 2.5), (side * aside, behind, z), side * turn, 18) for z in (5, -5) for side in (-1, 1)]


CASES: Dict[str, List[Part]] = {
    "clean": [],
    "screws": screws(20, -24, -0.5),
    "crossing": screws(13, -20, -0.5),
    "parallel": screws(11, -18, np.pi / 2 + 0.25),
    "two screws": [part._replace(centre=part.centre[:2] + (0,)) for part in screws(20, -24, -0.5)[:2]],
    "rods": [Part(True, (3, 3, 19), (-17, -26, 0), 0, 9), Part(True, (3, 3, 19), (18, -24, 0), 0, 9)],
    # of 1.6 mm; the last part is what the mass is taken of
    "wire": [Part(False, (24, 0.8, 0.8), (-10, 16, 2), 0.3, 9)],
    "vessel": [Part(False, (24, 2.2, 2.2), (-6, 12, 2), 0.4, 4)],
}


def own_frame(part: Part, vectors: np.ndarray) -> np.ndarray:
    c, s = np.cos(part.turn), np.sin(part.turn)
    return np.stack([c * vectors[..., 0] + s * vectors[..., 1], c * vectors[..., 1] - s * vectors[..., 0], vectors[..., 2]], -1)


def chord(part: Part, source: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """mm of each ray (of length 1) within the part."""
    start = own_frame(part, source - np.array(part.centre)) / part.axes
    way = own_frame(part, rays) / part.axes
    round_axes = slice(0, 2) if part.cylinder else slice(0, 3)
    a = (way[..., round_axes] ** 2).sum(-1)
    b = (way[..., round_axes] * start[round_axes]).sum(-1)
    root = b * b - a * ((start[round_axes] ** 2).sum() - 1)
    half = np.sqrt(np.maximum(root, 0)) / a
    low, high = -b / a - half, -b / a + half
    if part.cylinder:
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(-1 - start[2]) / way[..., 2], (1 - start[2]) / way[..., 2]])
        low, high = np.maximum(low, ends.min(0)), np.minimum(high, ends.max(0))
    return np.where(root > 0, np.maximum(high - low, 0), 0)


def project(parts: List[Part]) -> np.ndarray:
    """Line integrals, [view][row][column]."""
    columns = (np.arange(COLUMNS) - (COLUMNS - 1) / 2) * PIXEL
    rows = (np.arange(ROWS) - (ROWS - 1) / 2) * PIXEL
    views = np.zeros((VIEWS, ROWS, COLUMNS))
    for view, angle in enumerate(np.radians(3.7 + np.arange(VIEWS) * 360 / VIEWS)):
        out, across = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
        rays = columns[None, :, None] * across + rows[:, None, None] * np.array([0, 0, 1]) - FAR * out
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        for part in parts:
            views[view] += WATER * part.density * chord(part, NEAR * out, rays)
    return views


def make(case: str, directory: str) -> None:
    raw = case != "clean"
    views = project(BODY + CASES[case])
    if raw:
        views = np.random.default_rng(11).poisson(PHOTONS * np.exp(-views))
    projections = {"count": VIEWS, "sample": "float32", "quantity": "intensity" if raw else "line_integral"}
    if raw:
        projections["air"] = PHOTONS
    os.makedirs(directory)
    views.astype("<f4").tofile(os.path.join(directory, "projections.raw"))
    with open(os.path.join(directory, "scan.json"), "w", encoding="utf-8") as file:
        json.dump(
            {
                "name": f"metal: {case}",
                "detector": {"columns": COLUMNS, "rows": ROWS, "pixel_mm": [PIXEL, PIXEL]},
                "projections": projections,
                "geometry": {
                    "kind": "circular",
                    "source_to_isocentre_mm": NEAR,
                    "source_to_detector_mm": FAR,
                    "first_angle_deg": 3.7,
                    "angle_step_deg": 360 / VIEWS,
                },
            },
            file,
        )


def load(path: str) -> np.ndarray:
    """HU, [z][y][x]: the voxels are the last bytes of the file."""
    voxels = np.fromfile(path, "u1")[-4 * int(np.prod(SIZE)) :].view("<f4")
    return 1000 * (voxels.reshape(SIZE[::-1]) / WATER - 1)


def within(part: Part, places: np.ndarray, more: float) -> np.ndarray:
    """Whether a place lies in the part, grown by so many mm."""
    near = own_frame(part, places - np.array(part.centre)) / (np.array(part.axes) + more)
    if part.cylinder:
        return (np.hypot(near[..., 0], near[..., 1]) <= 1) & (np.abs(near[..., 2]) <= 1)
    return (near**2).sum(-1) <= 1


def beside(case: str, clean: str, volume: str) -> Dict[str, Any]:
    more = load(volume) - load(clean)
    axes = [(np.arange(count) - (count - 1) / 2) * SPACING for count in SIZE]
    places = np.stack(np.meshgrid(*axes[::-1], indexing="ij")[::-1], -1)
    parts = CASES[case]
    touched = np.any([within(part, places, 3.2) for part in parts], 0)
    reached = np.any([within(part, places, 10) for part in parts], 0)
    body = within(BODY[0], places, -4) & (np.abs(places[..., 2]) < 12)
    there = reached & ~touched & body
    bone = there & within(BONE, places, -2)
    part = parts[-1]
    mass = 1000 * part.density * 4 / 3 * np.pi * np.prod(part.axes)
    return {
        "rmse": float(np.sqrt((more[there] ** 2).mean())),
        "bone": float(more[bone].mean()) if bone.any() else None,
        "mass": float(more[within(part, places, 3.2)].sum() * SPACING**3 / mass),
        "voxels": int(there.sum()),
    }


def main(arguments: List[str]) -> None:
    if arguments[:1] == ["make"] and len(arguments) == 3:
        make(*arguments[1:])
    elif arguments[:1] == ["beside"] and len(arguments) == 4:
        print(json.dumps(beside(*arguments[1:])))
    elif arguments == ["grid"]:
        print(json.dumps({"size": SIZE, "spacing_mm": [SPACING] * 3}))
    elif arguments[:1] == ["dark"] and len(arguments) == 2:
        print(int((np.fromfile(os.path.join(arguments[1], "projections.raw"), "<f4") == 0).sum()))
    else:
        sys.exit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])
