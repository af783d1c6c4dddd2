#!/usr/bin/python3
"""Scans whose views stood elsewhere than a circle says, and how far what a job has found of that is off.

Usage: poses.py tenth CIRCLE SAG OUT     a scan document with views a tenth of the way from those of CIRCLE to those of SAG
       poses.py nod CIRCLE OUT           one of an object that nods by 3 degrees and 3 mm amid the sweep, seen from itself
       poses.py place TRUE TOLD FOUND OUT  a scan document with the poses that a refinement (FOUND, a job's document of it)
                                         gave the views of TOLD, moved as a whole to where they fit those of TRUE best;
                                         FOUND "-": those of TOLD as they are. Prints the mm at the isocentre that points
                                         lie aside, root mean square: in that place, and where the poses have them
       poses.py compare BODY VOLUME ...  JSON: of each volume, float32 voxels in 1/mm, the root mean square HU by which it
                                         differs from BODY ("truth") and from the first one ("first"), where BODY has more
                                         than half of water; BODY's last bytes are as many such voxels

CIRCLE, SAG, TRUE and TOLD are scan documents with "kind": "views".
"""
import json
import sys
from typing import Any, Dict, List, Tuple

import numpy as np

WATER = 0.0192
NECK = np.array([0.0, 20.0, -60.0])
POINTS = np.array([(x, y, z, 1.0) for x in (-50, 50) for y in (-50, 50) for z in (-40, 40)]).T
VECTORS = ("source_mm", "pixel0_mm", "column_step_mm", "row_step_mm")


def read(name: str) -> Dict[str, Any]:
    with open(name, encoding="utf-8") as file:
        document: Dict[str, Any] = json.load(file)
    return document


def write(name: str, document: Dict[str, Any], geometry: Dict[str, Any]) -> None:
    with open(name, "w", encoding="utf-8") as file:
        json.dump({**document, "geometry": geometry}, file)


def rigid(numbers: np.ndarray) -> np.ndarray:
    """Of a shift in mm and a vector of rotation in radians (Rodrigues 1840)."""
    x, y, z = numbers[3:]
    angle = np.linalg.norm(numbers[3:])
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    if angle > 0:
        matrix[:3, :3] += np.sin(angle) / angle * across + (1 - np.cos(angle)) / angle**2 * across @ across
    matrix[:3, 3] = numbers[:3]
    return matrix


def nod(share: float) -> np.ndarray:
    """Where the object lies at this share of the sweep: about the neck, and along y and z."""
    behind = 0.5 + 0.5 * np.sin(np.pi * np.clip((share - 0.5) / 0.1, -0.5, 0.5))
    turn = np.array([np.radians(3) * behind, 0, 0])
    turned = rigid(np.concatenate([np.zeros(3), turn]))[:3, :3] @ NECK
    return rigid(np.concatenate([NECK - turned + np.array([0, 1, 1]) * 3 / np.sqrt(2) * behind, turn]))


def matrix_of(view: Dict[str, List[float]]) -> np.ndarray:
    """3x4, from a point to its pixel."""
    source, pixel0, column, row = (np.array(view[name]) for name in VECTORS)
    inverse = np.linalg.inv(np.stack([column, row, pixel0 - source], axis=1))
    return np.hstack([inverse, (-inverse @ source)[:, None]])


def matrices_of(document: Dict[str, Any]) -> np.ndarray:
    return np.array([matrix_of(view) for view in document["geometry"]["views"]])


def found_matrices(told: np.ndarray, found: Dict[str, Any]) -> np.ndarray:
    if found["kind"] == "geometry":
        return np.array(found["geometry"]["matrices"]).reshape(-1, 3, 4)
    motions = {view["projection"]: np.concatenate([view["shift_mm"], np.radians(view["turn_deg"])]) for view in found["views"]}
    return np.array([matrix @ rigid(motions[k]) for k, matrix in enumerate(told)])


def seen(matrices: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Pixels of the points, moved as a whole."""
    pixels = matrices @ rigid(numbers) @ POINTS
    return (pixels[:, :2] / pixels[:, 2:]).ravel()


def best_place(true: np.ndarray, said: np.ndarray) -> Tuple[np.ndarray, float, float]:
    """By Gauss and Newton; pixels, root mean square, there and as they are."""
    wanted, numbers = seen(true, np.zeros(6)), np.zeros(6)
    for _ in range(6):
        here = seen(said, numbers)
        slopes = np.stack([(seen(said, numbers + 1e-4 * one) - here) / 1e-4 for one in np.eye(6)], axis=1)
        numbers = numbers + np.linalg.lstsq(slopes, wanted - here, rcond=None)[0]
    there, here = (np.sqrt(2 * np.mean((wanted - seen(said, at)) ** 2)) for at in (numbers, np.zeros(6)))
    return numbers, float(there), float(here)


def place(true: str, told: str, found: str, out: str) -> None:
    document = read(true)
    said = matrices_of(read(told))
    if found != "-":
        said = found_matrices(said, read(found))
    numbers, *pixels = best_place(matrices_of(document), said)
    moved = (said @ rigid(numbers)).reshape(-1, 12).tolist()
    write(out, document, {"kind": "matrices", "matrices": moved})
    print(*(f"{620 / 1100 * document['detector']['pixel_mm'][0] * aside:.4f}" for aside in pixels))


def compare(body: str, names: List[str]) -> None:
    volumes = [np.fromfile(name, "<f4").astype(float) for name in names]
    with open(body, "rb") as file:
        truth = np.frombuffer(file.read()[-4 * volumes[0].size :], "<f4").astype(float)
    inside = truth > 0.5 * WATER
    errors = {}
    for name, volume in zip(names, volumes):
        to_truth, to_first = (float(np.sqrt(np.mean(((volume - other) / WATER * 1000)[inside] ** 2))) for other in (truth, volumes[0]))
        errors[name.split("/")[-1].replace(".raw", "")] = {"truth": to_truth, "first": to_first}
    json.dump(errors, sys.stdout)


def main() -> None:
    what, *names = sys.argv[1:]
    if what == "tenth":
        circle, sag = read(names[0]), read(names[1])
        pairs = zip(circle["geometry"]["views"], sag["geometry"]["views"])
        views = [{v: list(0.9 * np.array(a[v]) + 0.1 * np.array(b[v])) for v in VECTORS} for a, b in pairs]
        write(names[2], circle, {"kind": "views", "views": views})
    elif what == "nod":
        circle = read(names[0])
        views = circle["geometry"]["views"]
        for k, view in enumerate(views):
            back = np.linalg.inv(nod(k / len(views)))
            for name in VECTORS:
                point = 1.0 if name in VECTORS[:2] else 0.0
                view[name] = list((back @ np.array([*view[name], point]))[:3])
        write(names[1], circle, circle["geometry"])
    elif what == "place":
        place(*names)
    else:
        compare(names[0], names[1:])


main()
