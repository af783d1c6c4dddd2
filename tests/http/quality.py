#!/usr/bin/env python3
"""A volume's `quality` against what numpy finds in volumes whose difference is known to be noise or rings.

Usage: quality.py VOLUMES.json CLEAN.raw NOISY.raw RINGS.raw NX NY NZ SPACING

VOLUMES.json: {"clean": {...}, "noisy": {...}, "rings": {...}}, the documents' members `quality`. The volumes are raw
float32 in 1/mm of the same ball, without noise, with noise, and with columns of the detector that are off.
"""
import json
import sys

import numpy as np

WATER = 0.0192

with open(sys.argv[1], encoding="utf-8") as file:
    quality = json.load(file)
nx, ny, nz = (int(text) for text in sys.argv[5:8])
spacing = float(sys.argv[8])
clean, noisy, rings = (1000 / WATER * np.fromfile(name, "<f4").reshape(nz, ny, nx).astype(float) for name in sys.argv[2:5])
z, y, x = np.meshgrid(*(spacing * (np.arange(n) - (n - 1) / 2) for n in (nz, ny, nx)), indexing="ij")
inside = np.hypot(np.hypot(x, y), z) < 30
failed = False


def expect(name: str, got: float, wanted: float, share: float) -> None:
    global failed
    print(f"{name}: {got:.3g}, numpy {wanted:.3g}")
    if not abs(got - wanted) <= share * wanted:
        print(f"expected: {name} within {share:g} of numpy's")
        failed = True


# Noise alone, over all of the ball: what is there of it at low frequencies, too.
noise = noisy - clean
expect("noise_hu", quality["noisy"]["noise_hu"], float(np.std(noise[inside])), 0.15)

# Rings alone: their mean over each circle, less that of the circles two voxels on both sides.
radius = np.rint(np.hypot(x, y) / spacing).astype(int)
squares = []
for k in range(nz):
    level = [(rings - clean)[k][inside[k] & (radius[k] == r)] for r in range(int(30 / spacing))]
    means = [one.mean() if one.size >= 40 else np.nan for one in level]
    squares += [(means[r] - (means[r - 2] + means[r + 2]) / 2) ** 2 / 1.5 for r in range(3, len(means) - 2)]
expect("ring_hu", quality["rings"]["ring_hu"], float(np.sqrt(np.nanmean(squares))), 0.4)
if quality["clean"]["ring_hu"] > 0.2 * quality["rings"]["ring_hu"]:
    print(f"expected: no rings without, got {quality['clean']['ring_hu']}")
    failed = True

# The edge: between its quartiles along the rays from the ball's centre, in those slices that the daemon looks at.
middle = slice(nz // 2 - 12, nz // 2 + 12)
share = clean[middle] / np.median(clean[inside])
distance = np.sqrt(x**2 + y**2 + z**2)[middle]
steep = np.abs(z[middle]) < 0.3 * distance
bins = np.arange(34, 46, spacing / 8)
profile = np.array([share[steep & (distance >= low) & (distance < low + spacing / 8)].mean() for low in bins])
quartiles = [np.interp(-level, -profile, bins) for level in (0.75, 0.25)]
expect("edge_mm", quality["clean"]["edge_mm"], 2.35482 / (2 * 0.67449) * (quartiles[1] - quartiles[0]), 0.15)
sys.exit(failed)
