"""rays.py FINE COARSE RAYS PHOTONS: a scan directory of line integrals, whose pixels become the rays of coarser ones.

A pixel has the mean intensity of RAYS x RAYS, with Poisson noise of so many photons in a pixel of air. rays.py compare FOUND TRUTH
RAYS: the RMS distance, in coarse pixels, between where a calibration's matrices and those of the fine scan's document see
points of the volume.
"""
import json
import os
import sys

import numpy


def coarser(fine, coarse, rays, photons):
    with open(os.path.join(fine, "scan.json")) as file:
        document = json.load(file)
    detector, count = document["detector"], document["projections"]["count"]
    rows, columns = detector["rows"] // rays, detector["columns"] // rays
    lines = numpy.fromfile(os.path.join(fine, "projections.raw"), "<f4").reshape(count, rows, rays, columns, rays)
    means = numpy.exp(-lines.astype(float)).mean(axis=(2, 4))
    counts = numpy.random.default_rng(1).poisson(photons * means)
    os.makedirs(coarse, exist_ok=True)
    (-numpy.log(numpy.maximum(counts, 0.5) / photons)).astype("<f4").tofile(os.path.join(coarse, "projections.raw"))
    document["detector"] = {"columns": columns, "rows": rows, "pixel_mm": [rays * pitch for pitch in detector["pixel_mm"]]}
    with open(os.path.join(coarse, "scan.json"), "w") as file:
        json.dump(document, file)


def compare(found, truth, rays):
    with open(found) as file:
        found = json.load(file)["geometry"]["matrices"]
    with open(truth) as file:
        truth = json.load(file)["geometry"]["matrices"]
    points = numpy.array([[x, y, z, 1] for x in (-40, 0, 40) for y in (-40, 0, 40) for z in (-40, 0, 40)]).T
    squares = []
    for ours, theirs in zip(found, truth):
        seen = [numpy.array(matrix).reshape(3, 4) @ points for matrix in (ours, theirs)]
        pixels = [rays_to[:2] / rays_to[2] for rays_to in seen]
        # a pixel's middle is that of its rays
        squares.append(((pixels[0] - (pixels[1] - (rays - 1) / 2) / rays) ** 2).sum(axis=0).mean())
    print(f"{numpy.sqrt(numpy.mean(squares)):.4f}")


if sys.argv[1] == "compare":
    compare(sys.argv[2], sys.argv[3], int(sys.argv[4]))
else:
    coarser(sys.argv[1], sys.argv[2], int(sys.argv[3]), float(sys.argv[4]))
