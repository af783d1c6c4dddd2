"""What `make paper` reconstructs, and what its results are compared with. Nothing here comes from the project's programs.

The head of Kak and Slaney is voxelised here; projections of voxel objects are made by paper-project (project.c), exact
integrals through the ellipsoids by the formula below. Volumes are float32 [z][y][x] in 1/mm, centred on the isocentre;
projections float32 [view][row][column]; lengths in mm.
"""

import json
import os
import subprocess
import tempfile

import numpy as np

CUBE_MM = 256 * 0.3725  # side of the cube that the head fills
WATER = 0.0192  # 1/mm
SOURCE_TO_ISOCENTRE, SOURCE_TO_DETECTOR = 620.0, 1100.0

# Semi-axes x y z | centre x y z | turn about z in degrees | density, of a cube from -1 to 1; high contrast.
HEAD = (
    (0.69, 0.92, 0.9, 0, 0, 0, 0, 1.0),
    (0.6624, 0.874, 0.88, 0, 0, 0, 0, -0.8),
    (0.41, 0.16, 0.21, -0.22, 0, -0.25, 108, -0.2),
    (0.31, 0.11, 0.22, 0.22, 0, -0.25, 72, -0.2),
    (0.21, 0.25, 0.5, 0, 0.35, -0.25, 0, 0.1),
    (0.046, 0.046, 0.046, 0, 0.1, -0.25, 0, 0.1),
    (0.046, 0.023, 0.02, -0.08, -0.65, -0.25, 0, 0.1),
    (0.046, 0.023, 0.02, 0.06, -0.65, -0.25, 90, 0.1),
    (0.056, 0.04, 0.1, 0.06, -0.105, 0.625, 90, 0.1),
    (0.056, 0.056, 0.1, 0, 0.1, 0.625, 0, 0.1),
)


def _ellipsoids():
    """(centre in mm, 3 x 3 from the world to the unit ball, density in 1/mm) of each."""
    half = CUBE_MM / 2
    for a, b, c, x, y, z, turn, density in HEAD:
        cos, sin = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        own = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        yield np.array([x, y, z]) * half, own / (np.array([[a], [b], [c]]) * half), density * WATER


def head_voxels(side, samples):
    """The head on side^3 voxels, each the mean of samples^3 points."""
    volume = np.zeros((side, side, side), np.float64)
    fine = side * samples
    points = ((np.arange(fine) + 0.5) / fine - 0.5) * CUBE_MM
    for centre, matrix, density in _ellipsoids():
        reach = np.sqrt((np.linalg.inv(matrix) ** 2).sum(1))  # half of the box around it
        box = []
        for axis in range(3):
            inside = np.flatnonzero(np.abs(points - centre[axis]) <= reach[axis])
            box.append((inside[0] // samples, inside[-1] // samples + 1))
        x, y = (points[box[i][0] * samples : box[i][1] * samples] - centre[i] for i in (0, 1))
        for z in range(*box[2]):
            total = 0
            for at in points[z * samples : (z + 1) * samples] - centre[2]:
                local = [row[0] * x[None, :] + row[1] * y[:, None] + row[2] * at for row in matrix]
                total = total + (sum(part * part for part in local) <= 1)
            shape = (box[1][1] - box[1][0], samples, box[0][1] - box[0][0], samples)
            share = total.reshape(shape).sum((1, 3)) / samples**3
            volume[z, box[1][0] : box[1][1], box[0][0] : box[0][1]] += density * share
    return volume.astype(np.float32)


def abdomen_hu(data):
    """The real CT volume in HU, or None where it is not here."""
    path = os.path.join(data, "abdomen_ts3mm.f32.zst")
    if not os.path.exists(path):
        return None
    raw = subprocess.run(["zstd", "-dc", path], check=True, stdout=subprocess.PIPE).stdout
    return np.frombuffer(raw, "<f4").reshape(112, 101, 122)


def _linear(volume, axis, places):
    """Linear interpolation along an axis; the first or last value outside."""
    last = volume.shape[axis] - 1
    low = np.clip(np.floor(places).astype(int), 0, last - 1)
    shape = [1, 1, 1]
    shape[axis] = -1
    part = np.clip(places - low, 0, 1).reshape(shape)
    return np.take(volume, low, axis) * (1 - part) + np.take(volume, low + 1, axis) * part


def anatomy_voxels(data, size, step, middle):
    """A box of the abdomen in 1/mm on size (x, y, z) voxels, every `step` of its own voxels, about the voxel `middle`
    (x, y, z); air outside."""
    hu = abdomen_hu(data)
    if hu is None:
        return None
    mu = np.maximum(0, WATER * (1 + hu.astype(np.float64) / 1000))
    for axis, i in ((0, 2), (1, 1), (2, 0)):
        places = (np.arange(size[i]) - (size[i] - 1) / 2) * step + middle[i]
        inside = (places >= -0.5) & (places <= mu.shape[axis] - 0.5)
        shape = [1, 1, 1]
        shape[axis] = -1
        mu = _linear(mu, axis, places) * inside.reshape(shape)
    return mu.astype(np.float32)


def circle(views, columns, rows, pixel_mm):
    """[view][4][3] of a full turn: source, pixel 0,0, column step, row step."""
    angles = 2 * np.pi * np.arange(views) / views
    out = np.zeros((views, 4, 3))
    radial = np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
    along = np.stack([-np.sin(angles), np.cos(angles), 0 * angles], 1) * pixel_mm
    up = np.array([0, 0, pixel_mm])
    out[:, 0] = SOURCE_TO_ISOCENTRE * radial
    out[:, 2], out[:, 3] = along, up
    middle = (SOURCE_TO_ISOCENTRE - SOURCE_TO_DETECTOR) * radial
    out[:, 1] = middle - along * (columns - 1) / 2 - up * (rows - 1) / 2
    return out


def of_matrices(matrices):
    """[view][4][3] of 3 x 4 matrices that take (x, y, z, 1) in mm to w (column, row, 1); the pixel's width is free: the
    detector stands 1000 mm from the source along its normal."""
    out = np.zeros((len(matrices), 4, 3))
    for view, matrix in enumerate(np.asarray(matrices, float)):
        m = matrix[:, :3] * np.sign(np.linalg.det(matrix[:, :3]))
        source = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
        rays = np.linalg.inv(m).T  # direction to pixel (c, r): c rays[0] + r rays[1] + rays[2]
        normal = np.cross(rays[0], rays[1])
        depth = abs(rays[2] @ normal) / np.linalg.norm(normal)
        side = 1.0 if source @ (m[2]) < 0 else -1.0  # the detector is where the isocentre is
        rays = rays * side * 1000 / depth
        out[view] = source, source + rays[2], rays[0], rays[1]
    return out


def project_voxels(program, volume, spacing, views, columns, rows):
    """Through the voxels' trilinear interpolation (project.c)."""
    with tempfile.TemporaryDirectory() as folder:
        paths = [os.path.join(folder, name) for name in ("volume", "views", "out")]
        np.ascontiguousarray(volume, np.float32).tofile(paths[0])
        np.ascontiguousarray(views, np.float64).tofile(paths[1])
        numbers = [*volume.shape[::-1], *spacing]
        command = [program, paths[0], *map(str, numbers), paths[1], str(columns), str(rows), paths[2]]
        subprocess.run(command, check=True)
        return np.fromfile(paths[2], np.float32).reshape(len(views), rows, columns)


def project_head(views, columns, rows):
    """Exact integrals through the ellipsoids: of |m (s + t d - c)|^2 <= 1 the interval of t, times |d|."""
    out = np.zeros((len(views), rows, columns), np.float32)
    c, r = np.arange(columns)[None, :, None], np.arange(rows)[:, None, None]
    for view, (source, pixel0, u, v) in enumerate(views):
        direction = pixel0 + c * u + r * v - source
        length = np.linalg.norm(direction, axis=-1)
        for centre, matrix, density in _ellipsoids():
            from_, along = matrix @ (source - centre), direction @ matrix.T
            aa, ab = (along * along).sum(-1), along @ from_
            root = ab * ab - aa * (from_ @ from_ - 1)
            out[view] += (density * length * 2 * np.sqrt(np.maximum(root, 0)) / aa).astype(np.float32)
    return out


def multiplicative_noise(projections, seed=2010):
    """p (1 - 0.3 r), r even in 0..1."""
    r = np.random.Generator(np.random.PCG64(seed)).random(projections.shape)
    return (projections * (1 - 0.3 * r)).astype(np.float32)


def photon_noise(projections, photons, seed=2010):
    """Line integrals of counts of so many photons in the open beam; a pixel without a photon counts half of one."""
    counts = np.random.Generator(np.random.PCG64(seed)).poisson(photons * np.exp(-projections.astype(np.float64)))
    return -np.log(np.maximum(counts, 0.5) / photons).astype(np.float32)


# ---- errors against the truth ----


def _gauss(volume, kernel):
    """Along all three axes, where the kernel lies within the volume."""
    for axis in range(3):
        length = volume.shape[axis] - len(kernel) + 1
        parts = (weight * volume.take(range(i, i + length), axis) for i, weight in enumerate(kernel))
        volume = sum(parts)
    return volume


def ssim(volume, truth):
    """Structural similarity in 3D (Wang 2004): windows are Gaussian, sigma 1.5 and 11 voxels wide, K1 = .01, K2 = .03, the
    range is that of the truth; mean over all windows that lie within the volume."""
    x, y = (np.asarray(v, np.float64) for v in (volume, truth))
    span = y.max() - y.min()
    kernel = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    kernel /= kernel.sum()
    c1, c2 = (0.01 * span) ** 2, (0.03 * span) ** 2
    mx, my = _gauss(x, kernel), _gauss(y, kernel)
    vx, vy, vxy = _gauss(x * x, kernel) - mx * mx, _gauss(y * y, kernel) - my * my, _gauss(x * y, kernel) - mx * my
    return float(((2 * mx * my + c1) * (2 * vxy + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))).mean())


def errors(volume, truth, with_ssim=True):
    """relative: ||v - t|| / ||t||; rmse in 1/mm and HU; psnr in dB, its peak the truth's maximum; ssim as above."""
    difference = volume.astype(np.float64) - truth
    rmse = float(np.sqrt((difference**2).mean()))
    row = {
        "relative": float(np.linalg.norm(difference) / np.linalg.norm(truth.astype(np.float64))),
        "rmse_per_mm": rmse,
        "rmse_hu": rmse / WATER * 1000,
        "psnr_db": float(20 * np.log10(truth.max() / rmse)) if rmse > 0 else None,
    }
    if with_ssim:
        row["ssim"] = ssim(volume, truth)
    return row


# ---- pictures ----


def gray(image, low, high):
    """uint8 of a plane, 0 at low and 255 at high."""
    return np.clip(np.rint((np.asarray(image, np.float64) - low) / (high - low) * 255), 0, 255).astype(np.uint8)


def render(volume, spacing, transfer, azimuth=-90.0, elevation=45.0, width=240, height=110):
    """Volume rendering by compositing front to back along parallel rays, with light from the viewer. transfer: (value
    in 1/mm, red, green, blue, opacity per mm), between which colours are linear. Returns uint8 [row][column][3]."""
    extent = np.array(volume.shape[::-1]) * spacing
    a, e = np.radians(azimuth), np.radians(elevation)
    toward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])  # from the object to the viewer
    right = np.array([-np.sin(a), np.cos(a), 0])
    up = np.cross(toward, right)
    half = np.linalg.norm(extent) / 2
    step = float(min(spacing))
    scale = 1.02 * (np.abs(right) @ extent) / width
    across = (np.arange(width) - (width - 1) / 2) * scale
    down = ((height - 1) / 2 - np.arange(height)) * scale
    plane = across[None, :, None] * right + down[:, None, None] * up
    table = np.array(transfer)
    light = np.zeros((height, width, 3))
    clear = np.ones((height, width))
    # The gradient once for the volume, so that each sample needs two look-ups.
    slopes = np.stack(np.gradient(volume, spacing[2], spacing[1], spacing[0]), -1).astype(np.float32)
    for at in np.arange(half, -half, -step):
        place = (plane + at * toward) / spacing + (np.array(volume.shape[::-1]) - 1) / 2
        inside = np.all((place >= 0) & (place <= np.array(volume.shape[::-1]) - 1), -1) & (clear > 0.01)
        if not inside.any():
            continue
        x, y, z = place[inside].T
        low = [np.minimum(p.astype(int), n - 2) for p, n in zip((x, y, z), volume.shape[::-1])]
        part = [p - i for p, i in zip((x, y, z), low)]
        value, slope = 0, 0
        for corner in range(8):
            i, j, k = corner & 1, corner >> 1 & 1, corner >> 2
            weight = np.prod([p if bit else 1 - p for p, bit in zip(part, (i, j, k))], axis=0)
            index = (low[2] + k, low[1] + j, low[0] + i)
            value = value + weight * volume[index]
            slope = slope + weight[:, None] * slopes[index]
        colour = np.stack([np.interp(value, table[:, 0], table[:, n]) for n in (1, 2, 3)], -1)
        opacity = 1 - np.exp(-step * np.interp(value, table[:, 0], table[:, 4]))
        norm = np.linalg.norm(slope, axis=-1)
        facing = np.abs(slope @ toward[::-1]) / np.maximum(norm, 1e-9)
        shade = 0.35 + 0.65 * facing
        light[inside] += (clear[inside] * opacity * shade)[:, None] * colour
        clear[inside] *= 1 - opacity
    return np.clip(np.rint(light * 255), 0, 255).astype(np.uint8)


def write_json(path, document):
    with open(path, "w", encoding="ascii") as file:
        json.dump(document, file)
        file.write("\n")
