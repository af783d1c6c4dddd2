#!/usr/bin/python3
"""The test object with a mark on each side, and where a volume's file says that the marks lie.

Usage: sides.py make DIR [counts]              a scan directory of the object, by exact line integrals
       sides.py check POSITION JOB SCAN FORMAT,UNIT,FILE ...
                                               JOB and SCAN may be ""; a POSITION with an @ behind it is that of a
                                               patient in whose own axes the marks were made; POSITION: HFS ..., unknown, or tilted (world_to_patient of TILT)
       sides.py old FILE                       the same volume as files were before they had an extension

A ball of water, in it three smaller ones of other densities towards the world's +x, +y and +z, none at its mirror
image. Exits with 1 and a reason where a file puts them elsewhere than the position says.
"""
import json
import re
import sys
from typing import Any, Dict, List, Tuple

import numpy as np

# centre in the world's mm, radius, what it adds to the attenuation in 1/mm
WATER = 0.0192
BALLS = [
    ((2.0, -1.0, 3.0), 34.0, WATER),
    ((20.0, 0.0, 2.0), 6.0, 0.02),
    ((0.0, 19.0, -3.0), 5.0, 0.04),
    ((-2.0, 3.0, 21.0), 4.5, 0.08),
]
VIEWS, COLUMNS, ROWS, PIXEL, NEAR, FAR = 72, 72, 72, 2.0, 600.0, 1000.0

# Where the world's x, y and z point to for each of DICOM's positions, on a table whose +y is the floor and whose +z
# is the end that comes first: written down by hand, as nibabel names axes.
AXES = {
    "HFS": ("L", "P", "S"),
    "HFP": ("R", "A", "S"),
    "FFS": ("R", "P", "I"),
    "FFP": ("L", "A", "I"),
    "HFDL": ("A", "L", "S"),
    "HFDR": ("P", "R", "S"),
    "FFDL": ("P", "L", "I"),
    "FFDR": ("A", "R", "I"),
}
AXES["unknown"] = AXES["HFS"]
LPS = {"L": (1, 0, 0), "R": (-1, 0, 0), "P": (0, 1, 0), "A": (0, -1, 0), "S": (0, 0, 1), "I": (0, 0, -1)}
# 40 degrees about z, then 15 about x, and a shift.
C, S, D, T = np.cos(np.radians(40)), np.sin(np.radians(40)), np.cos(np.radians(15)), np.sin(np.radians(15))
TILT = np.array([[C, -S, 0, 12], [D * S, D * C, -T, -7], [T * S, T * C, D, 150], [0, 0, 0, 1]])


def fail(text: str) -> None:
    sys.exit(text)


def world_to_patient(position: str) -> np.ndarray:
    if position == "tilted":
        return TILT
    matrix = np.eye(4)
    for axis, letter in enumerate(AXES[position]):
        matrix[:3, axis] = LPS[letter]
    return matrix


def chord(source: np.ndarray, direction: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """The length of each ray, from the source along unit vectors [..., 3], within a ball."""
    to = centre - source
    along = direction @ to
    return 2 * np.sqrt(np.maximum(0, radius**2 - (to @ to - along**2)))


def make(directory: str, counts: bool) -> None:
    columns = (np.arange(COLUMNS) - (COLUMNS - 1) / 2) * PIXEL
    rows = (np.arange(ROWS) - (ROWS - 1) / 2) * PIXEL
    stack = np.zeros((VIEWS, ROWS, COLUMNS), np.float32)
    for view in range(VIEWS):
        b = 2 * np.pi * view / VIEWS
        out = np.array([np.cos(b), np.sin(b), 0])
        u = np.array([-np.sin(b), np.cos(b), 0])
        source = NEAR * out
        middle = source - FAR * out
        ends = middle + columns[None, :, None] * u + rows[:, None, None] * np.array([0, 0, 1])
        rays = ends - source
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        for centre, radius, density in BALLS:
            stack[view] += density * chord(source, rays, np.array(centre), radius)
    if counts:
        stack = np.rint(50000 * np.exp(-stack)).astype("<u2")
    stack.tofile(directory + "/projections.raw")
    document = {
        "name": "sides \u00e9",
        "detector": {"columns": COLUMNS, "rows": ROWS, "pixel_mm": [PIXEL, PIXEL]},
        "projections": {"count": VIEWS, "sample": "float32", "quantity": "line_integral"},
        "geometry": {
            "kind": "circular",
            "source_to_isocentre_mm": NEAR,
            "source_to_detector_mm": FAR,
            "first_angle_deg": 0,
            "angle_step_deg": 360 / VIEWS,
        },
    }
    if counts:
        document["projections"].update(sample="uint16", quantity="intensity", air=50000)
    with open(directory + "/scan.json", "w", encoding="utf-8") as file:
        json.dump(document, file)


Volume = Tuple[np.ndarray, np.ndarray, str, Dict[str, Any]]


def read_nifti(path: str) -> Volume:
    """Voxels [x][y][z], the matrix to LPS mm, the description and what is told beside it; by nibabel."""
    import nibabel

    image = nibabel.load(path)
    header = image.header
    affine = header.get_sform()
    if not np.allclose(affine, header.get_qform(), atol=2e-3):
        fail(f"sform {affine} is not qform {header.get_qform()}")
    if header["sform_code"] != 1 or header["qform_code"] != 1:
        fail("the codes of a scanner's coordinates are expected")
    comments = [e for e in header.extensions if e.get_code() == 6]
    if len(comments) != 1:
        fail(f"one comment is expected as an extension, there are {len(comments)}")
    told = json.loads(comments[0].get_content())
    description = header["descrip"].item().decode("ascii")
    return np.asarray(image.dataobj, np.float64), np.diag([-1, -1, 1, 1]) @ affine, description, told


def told_by_keys(pairs: List[Tuple[str, str]]) -> Dict[str, Any]:
    """The members of NIfTI's extension from keys of their own."""
    told: Dict[str, Any] = {"recipe": {}}
    for key, value in pairs:
        name = key[len("cbct_") :]
        try:
            parsed = json.loads(value)
        except ValueError:
            parsed = json.loads(f'"{value}"')
        if name in ("job", "scan", "scan_name", "program", "unit", "stage"):
            parsed = json.loads(f'"{value}"')
        if name.startswith("recipe_"):
            told["recipe"][name[len("recipe_") :]] = parsed
        else:
            told[name] = parsed
    return told


def read_mha(path: str) -> Volume:
    with open(path, "rb") as file:
        data = file.read()
    end = data.index(b"ElementDataFile = LOCAL\n") + len(b"ElementDataFile = LOCAL\n")
    pairs = [tuple(line.split(" = ", 1)) for line in data[:end].decode("ascii").splitlines()]
    fields = dict(pairs)
    numbers = {key: np.array(fields[key].split(), float) for key in ("TransformMatrix", "Offset", "ElementSpacing")}
    size = [int(n) for n in fields["DimSize"].split()]
    kind = {"MET_FLOAT": "<f4", "MET_SHORT": "<i2"}[fields["ElementType"]]
    voxels = np.frombuffer(data, kind, offset=end).reshape(size[::-1]).T
    affine = np.eye(4)
    # Each row of the matrix is the direction of one axis of the voxels.
    affine[:3, :3] = numbers["TransformMatrix"].reshape(3, 3).T * numbers["ElementSpacing"]
    affine[:3, 3] = numbers["Offset"]
    # The letters name where the axes come from.
    opposite = dict(zip("LRPASI", "RLAPIS"))
    for axis, letter in enumerate(fields["AnatomicalOrientation"]):
        if affine[:3, axis] @ np.array(LPS[opposite[letter]]) < 0.57 * np.linalg.norm(affine[:3, axis]):
            fail(f"AnatomicalOrientation = {fields['AnatomicalOrientation']} for {affine}")
    if max(len(line) for line in data[:end].splitlines()) > 480:
        fail("MetaIO reads 500 bytes of a line")
    return voxels, affine, fields["Comment"], told_by_keys([p for p in pairs if p[0].startswith("cbct_")])


def read_nrrd(path: str) -> Volume:
    with open(path, "rb") as file:
        data = file.read()
    end = data.index(b"\n\n") + 2
    lines = data[:end].decode("ascii").splitlines()
    fields = dict(line.split(": ", 1) for line in lines[1:] if ":=" not in line and ": " in line)
    # NRRD's own escapes, of the backslash that begins them.
    keys = [tuple(line.replace("\\\\", "\\").split(":=", 1)) for line in lines if ":=" in line]
    if lines[0] != "NRRD0004" or fields["space"] != "left-posterior-superior" or fields["encoding"] != "raw":
        fail(f"a header of NRRD0004 in LPS: {lines}")
    vectors = [np.array(v.split(","), float) for v in re.findall(r"\(([^)]*)\)", fields["space directions"])]
    affine = np.eye(4)
    affine[:3, :3] = np.array(vectors).T
    affine[:3, 3] = np.array(fields["space origin"].strip("()").split(","), float)
    size = [int(n) for n in fields["sizes"].split()]
    voxels = np.frombuffer(data, {"float": "<f4", "short": "<i2"}[fields["type"]], offset=end).reshape(size[::-1]).T
    description = [line[2:] for line in lines if line.startswith("# ")][0]
    return voxels, affine, description, told_by_keys(keys)


READERS = {"nifti": read_nifti, "nifti.gz": read_nifti, "mha": read_mha, "nrrd": read_nrrd}


def level_at(volume: Volume, unit: str, point: np.ndarray) -> float:
    """Attenuation about a place in the patient: the mean of 3 x 3 x 3 voxels, or of the one where they are large."""
    voxels, affine = volume[:2]
    index = np.rint((np.linalg.inv(affine) @ np.append(point, 1))[:3]).astype(int)
    reach = 1 if np.linalg.norm(affine[:3, 0]) < 2.5 else 0
    if (index < reach).any() or (index + reach >= voxels.shape).any():
        fail(f"{point} mm of the patient is outside of the volume, at voxel {index} of {voxels.shape}")
    box = tuple(slice(i - reach, i + reach + 1) for i in index)
    level = float(voxels[box].mean())
    return level if unit == "1/mm" else WATER * (1 + level / 1000)


def check_marks(volume: Volume, unit: str, matrix: np.ndarray) -> None:
    for centre, _, density in BALLS[1:]:
        mirror = np.array(centre) * np.where(np.abs(centre) == np.max(np.abs(centre)), -1, 1)
        here = level_at(volume, unit, matrix[:3, :3] @ centre + matrix[:3, 3])
        there = level_at(volume, unit, matrix[:3, :3] @ mirror + matrix[:3, 3])
        # Voxels as large as the mark's radius take a part of what is around it; the other marks are twice and half.
        if not (0.7 * density < here - WATER < 1.3 * density and abs(there - WATER) < 0.25 * density):
            fail(f"the mark of {density}/mm at {centre}: {here - WATER:.4f} there, {there - WATER:.4f} across")


def check_words(volume: Volume, position: str, unit: str, ids: List[str]) -> None:
    _, _, description, told = volume
    known = position != "unknown"
    if ("left and right are not known" in description) == known or unit not in description:
        fail(f"the description \"{description}\"")
    expected = {"position": position} if position in AXES and known else None
    if known and position != "tilted" and position not in description:
        fail(f"the description \"{description}\" without {position}")
    if told["left_right"] != ("known" if known else "not known") or told["unit"] != unit:
        fail(f"what is told of left and right, and of the unit: {told}")
    if position != "tilted" and told["patient"] != expected:
        fail(f"patient is {told['patient']}, expected {expected}")
    if ("world_to_patient" in told) != known:
        fail(f"a matrix where the patient is known: {told}")
    if known and not np.allclose(np.array(told["world_to_patient"]).reshape(4, 4), world_to_patient(position), atol=1e-6):
        fail(f"the matrix {told['world_to_patient']}")
    if not re.match(r"cbctd? \d+\.\d+", told["program"]) or told["recipe"]["fdk"]["window"] != "hann":
        fail(f"program and recipe: {told}")
    if told["stage"] != "fdk" or told["iteration"] != 0 or told["scan_name"] != "sides \u00e9":
        fail(f"stage, iteration and the scan's name: {told}")
    if ids and [told["job"], told["scan"]] != ids:
        fail(f"job and scan {ids}: {told}")


def check(position: str, form: str, unit: str, path: str, ids: List[str]) -> None:
    volume = READERS[form](path)
    matrix = np.eye(4) if position.endswith("@") else world_to_patient(position)
    position = position.rstrip("@")
    if position != "tilted" and form.startswith("nifti"):
        import nibabel

        image = nibabel.load(path)
        for affine in (image.header.get_sform(), image.header.get_qform()):
            codes = nibabel.aff2axcodes(affine)
            if codes != AXES[position]:
                fail(f"axis codes {codes}, expected {AXES[position]}")
    check_marks(volume, unit, matrix)
    check_words(volume, position, unit, ids)


def old(path: str) -> None:
    with open(path, "r+b") as file:
        data = bytearray(file.read())
        start = int(np.frombuffer(data, "<f4", 1, 108)[0])
        data[108:112] = np.float32(352).tobytes()
        data[348:352] = bytes(4)
        file.seek(0)
        file.write(data[:352] + data[start:])
        file.truncate()


if __name__ != "__main__":
    pass
elif sys.argv[1] == "make":
    make(sys.argv[2], "counts" in sys.argv[3:])
elif sys.argv[1] == "old":
    old(sys.argv[2])
else:
    for argument in sys.argv[5:]:
        try:
            check(sys.argv[2], *argument.split(",", 2), [word for word in sys.argv[3:5] if word])
        except SystemExit as reason:
            fail(f"{sys.argv[2]} as {argument}: {reason}")
