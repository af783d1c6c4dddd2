#!/usr/bin/env python3
"""The slices of a volume of the real abdomen beside the abdomen: long_abdomen.py DIRECTORY SLICES

DIRECTORY has hu.raw, 122 x 101 x 112 voxels of 1.5 x 1.5 x 2.5 mm, scan.json with the matrices of the views that saw it,
and final.raw, 61 x 50 x SLICES voxels of 3 x 3 x 5 mm about the same middle. Prints {"seen": HU, "any": HU}, the largest
error of a slice's mean over the body, of the slices that all views see, and of all.
"""
import json
import os
import sys

import numpy as np

WATER = 0.0192


def main(directory: str, count: int) -> None:
    fine = np.fromfile(os.path.join(directory, "hu.raw"), "<f4").reshape(112, 101, 122)[:, :100]
    voxels = np.maximum(0, 1 + fine / 1000).reshape(56, 2, 50, 2, 61, 2).mean((1, 3, 5))
    truth = voxels[(56 - count) // 2 : (56 + count) // 2]
    found = np.fromfile(os.path.join(directory, "final.raw"), "<f4").reshape(truth.shape) / WATER
    body = truth > 0.5
    with open(os.path.join(directory, "scan.json"), encoding="utf-8") as file:
        document = json.load(file)
    axes = ((np.arange(count) - (count - 1) / 2) * 5, -74.25 + 3 * np.arange(50), -90 + 3 * np.arange(61))
    z, y, x = np.meshgrid(*axes, indexing="ij")
    places = np.stack([x, y, z, np.ones_like(x)])[:, body]
    on_rows = np.ones(body.sum(), bool)
    for matrix in np.reshape(document["geometry"]["matrices"], (-1, 3, 4)):
        row = matrix[1] @ places / (matrix[2] @ places)
        on_rows &= (row > -0.5) & (row < document["detector"]["rows"] - 0.5)
    unseen = np.zeros(body.shape, bool)
    unseen[body] = ~on_rows
    errors = [abs(1000 * float((found[k] - truth[k])[body[k]].mean())) for k in range(count)]
    print(json.dumps({"seen": max(e for e, lost in zip(errors, unseen.any((1, 2))) if not lost), "any": max(errors)}))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
