#!/usr/bin/python3
"""DICOM objects of a volume, read by two independent readers, pydicom and GDCM.

Usage: dicom.py check POSITION VOXELS.raw MEMBERS.json OBJECT ...
           VOXELS: the same volume as raw int16 [z][y][x]; MEMBERS: what attributes must say, by keyword; OBJECT: all
           slices, or one object with frames, or several of these with -- between. POSITION as of sides.py, whose object it is.
       dicom.py sources OBJECT ...       the UIDs that each references as its sources, wherever it must, behind their class
       dicom.py uids OBJECT ...          the UIDs of each, to compare
       dicom.py who NAME/.../OBJECT ...  NAME (before the file, or its "slices"), the patient's name and id, accession number,
           study UID: a line for each that differs
"""
import json
import os
import sys
from typing import List, Tuple

import gdcm
import numpy as np
import pydicom
import sides

Slices = List[Tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]  # position, orientation [6], spacing [row, column], pixels


def fail(text: str) -> None:
    sys.exit(text)


def slices_by_pydicom(paths: List[str]) -> Slices:
    found: Slices = []
    for path in paths:
        data = pydicom.dcmread(path)
        if "PerFrameFunctionalGroupsSequence" not in data:
            pixels = data.pixel_array * float(data.RescaleSlope) + float(data.RescaleIntercept)
            found.append(tuple(np.array(v, float) for v in (data.ImagePositionPatient, data.ImageOrientationPatient, data.PixelSpacing, pixels)))
            continue
        shared = data.SharedFunctionalGroupsSequence[0]
        scale = shared.PixelValueTransformationSequence[0]
        for frame, pixels in zip(data.PerFrameFunctionalGroupsSequence, data.pixel_array):
            found.append(
                (
                    np.array(frame.PlanePositionSequence[0].ImagePositionPatient, float),
                    np.array(shared.PlaneOrientationSequence[0].ImageOrientationPatient, float),
                    np.array(shared.PixelMeasuresSequence[0].PixelSpacing, float),
                    pixels * float(scale.RescaleSlope) + float(scale.RescaleIntercept),
                )
            )
    return found


def slices_by_gdcm(paths: List[str]) -> Slices:
    found: Slices = []
    for path in paths:
        reader = gdcm.ImageReader()
        reader.SetFileName(path)
        if not reader.Read():
            fail(f"{path}: GDCM cannot read it")
        image = reader.GetImage()
        size = [image.GetDimension(i) for i in range(image.GetNumberOfDimensions())]
        depth = size[2] if len(size) > 2 else 1
        spacing = np.array(image.GetSpacing())
        cosines = np.array(image.GetDirectionCosines())
        raw = np.frombuffer(image.GetBuffer().encode("utf-8", "surrogateescape"), "<i2").reshape(depth, size[1], size[0])
        pixels = raw * image.GetSlope() + image.GetIntercept()
        normal = np.cross(cosines[:3], cosines[3:])
        for z in range(depth):
            found.append((np.array(image.GetOrigin()) + z * spacing[2] * normal, cosines, spacing[[1, 0]], pixels[z]))
    return found


def assemble(slices: Slices) -> Tuple[np.ndarray, np.ndarray]:
    """Voxels [x][y][z] and their matrix to LPS mm; slices in the order of their places."""
    _, orientation, spacing, _ = slices[0]
    row, column = orientation[:3], orientation[3:]
    normal = np.cross(row, column)
    slices = sorted(slices, key=lambda one: one[0] @ normal)
    places = np.array([one[0] @ normal for one in slices])
    steps = np.diff(places)
    if not np.allclose(steps, steps[0], atol=1e-6) or any(not np.allclose(one[1], orientation, atol=1e-9) for one in slices):
        fail(f"slices at equal steps, all turned the same: {steps}")
    matrix = np.eye(4)
    matrix[:3, 0] = row * spacing[1]
    matrix[:3, 1] = column * spacing[0]
    matrix[:3, 2] = normal * steps[0]
    matrix[:3, 3] = slices[0][0]
    return np.stack([one[3] for one in slices]).transpose(2, 1, 0), matrix


def check(position: str, raw: str, members: str, paths: List[str]) -> None:
    with open(members, encoding="utf-8") as file:
        expected = json.load(file)
    turn = sides.world_to_patient(position)
    expected_matrix = turn @ np.array([[2, 0, 0, -40], [0, 2.4, 0, -42], [0, 0, 1.7, -41.65], [0, 0, 0, 1]])
    for name, read in (("pydicom", slices_by_pydicom), ("GDCM", slices_by_gdcm)):
        voxels, matrix = assemble(read(paths))
        truth = np.fromfile(raw, "<i2").reshape(voxels.shape[::-1]).transpose(2, 1, 0)
        if not np.array_equal(voxels, truth):
            fail(f"{name}: {np.count_nonzero(voxels != truth)} voxels are others than those of format=raw")
        if not np.allclose(matrix, expected_matrix, atol=1e-6):
            fail(f"{name}: the matrix\n{matrix}\nis not\n{expected_matrix}")
        sides.check_marks((voxels, matrix, "", {}), "HU", turn)
    for path in paths:
        data = pydicom.dcmread(path, stop_before_pixels=True)
        for key, value in expected.items():
            if str(data.get(key)) != value:
                fail(f"{path}: {key} is {data.get(key)!r}, expected {value!r}")
        pydicom.uid.UID(data.SOPInstanceUID).is_valid or fail("a valid UID")


KEYS = {
    "uids": ("SOPClassUID", "SOPInstanceUID", "SeriesInstanceUID", "StudyInstanceUID", "FrameOfReferenceUID"),
    "who": ("PatientName", "PatientID", "AccessionNumber", "StudyInstanceUID"),
}

if sys.argv[1] == "check":
    for group in "\n".join(sys.argv[5:]).split("\n--\n"):
        check(*sys.argv[2:5], group.split("\n"))
elif sys.argv[1] == "sources":
    for path in sys.argv[2:]:
        data = pydicom.dcmread(path, stop_before_pixels=True)
        shared = data.SharedFunctionalGroupsSequence[0].DerivationImageSequence[0] if "SharedFunctionalGroupsSequence" in data else data
        lists = [shared.SourceImageSequence]
        if "SourceImageEvidenceSequence" in data:
            lists.append(data.SourceImageEvidenceSequence[0].ReferencedSeriesSequence[0].ReferencedSOPSequence)
        elif shared is not data:
            lists.append(data.ReferencedSeriesSequence[0].ReferencedInstanceSequence)
        said = [" ".join([one[0].ReferencedSOPClassUID] + [item.ReferencedSOPInstanceUID for item in one]) for one in lists]
        len(set(said)) == 1 or fail(f"{path}: {said}")
        print(said[0])
else:
    lines = []
    for path in sys.argv[2:]:
        data = pydicom.dcmread(path, stop_before_pixels=True)
        name = [os.path.dirname(path.replace("/slices", "")).rsplit("/", 1)[-1]] if sys.argv[1] == "who" else []
        lines.append(" ".join(name + [str(data.get(key, "")) for key in KEYS[sys.argv[1]]]))
    print("\n".join(dict.fromkeys(lines) if sys.argv[1] == "who" else lines))
