#!/usr/bin/env python3
"""Draws docs/rooms.svg: the folders of the C sources and which of them includes which.

    docs/rooms.py           writes docs/rooms.svg
    docs/rooms.py --check   exits 1 if docs/rooms.svg is not the picture of the present includes

An arrow goes from a folder to one whose headers it includes. An arrow that a path of other arrows implies is left out,
so that the picture stays readable. Includes in a circle are an error. The same tree gives the same bytes.
"""
import re
import sys
from pathlib import Path
from xml.sax.saxutils import escape

ROOT = Path(__file__).resolve().parent.parent
PICTURE = ROOT / "docs" / "rooms.svg"

# Every folder with C or CUDA sources has a row, except tests. daemon/ itself holds the mains of two programs and the
# files that serve all folders beneath it, so those three have rows of their own; so have the errors, which core/scan
# knows, and the other files of core/ itself, which know core/scan.
ROOMS = {
    "daemon/main.c": "main of cbctd",
    "daemon/api": "routes and their handlers",
    "daemon/intake": "uploads",
    "daemon/jobs": "queue, supervisor",
    "daemon/calibrations": "library of calibrations",
    "daemon/sendings": "volumes to archives",
    "daemon/fleet": "jobs of other hosts",
    "daemon/dicom": "cbct-dicom",
    "daemon/volumes": "files, slices, streams, events",
    "daemon/http": "connections, requests, replies",
    "daemon/store": "catalogue, scan directories",
    "daemon/*.c": "settings, log, locks, watches",
    "daemon/worker.c": "main of cbct-worker",
    "clients/cbct": "command-line client",
    "proto": "JSON, file formats, messages",
    "core/recon": "algorithms, the run",
    "core/calibrate": "an arm's geometry from balls",
    "core/fit": "models of tube and detector",
    "core/correct": "corrections",
    "core/refine": "whether the geometry fits",
    "core/outofcore": "a backend over a backend",
    "core/cards": "several cards as one backend",
    "core/cpu": "CPU backend",
    "core/*.c": "backends' contract, FDK, filter",
    "core/scan": "geometry, grid, orbit",
    "core/error.c": "what went wrong, in words",
    "kernels": "CUDA backend",
}
COLOURS = {"daemon": "#dbe9f6", "proto": "#fdebc8", "core": "#dff0d8", "kernels": "#f6dbdb", "clients": "#e9e0f3"}

WIDTH, HEIGHT, GAP_X, GAP_Y, LANE, MARGIN, LEGEND = 216, 52, 28, 54, 16, 20, 30


def room_of(path):
    """The row of ROOMS that a file of the tree belongs to."""
    file = re.sub(r"\.h$", ".c", path)
    if file in ROOMS:
        return file
    folder = path.rpartition("/")[0]
    return folder + "/*.c" if folder in ("core", "daemon") else folder


def includes():
    """The set of (room, included room)."""
    arrows, found = set(), set()
    for top in ("clients", "core", "daemon", "kernels", "proto"):
        for file in sorted((ROOT / top).rglob("*")):
            if file.suffix not in (".c", ".h", ".cu", ".cuh") or "node_modules" in file.parts:
                continue
            room = room_of(file.relative_to(ROOT).as_posix())
            found.add(room)
            for included in re.findall(r'^#\s*include "([^"]+)"', file.read_text(), re.MULTILINE):
                if "/" in included and room_of(included) != room:
                    arrows.add((room, room_of(included)))
    if found | {r for arrow in arrows for r in arrow} != set(ROOMS):
        sys.exit(f"docs/rooms.py: either without a row in ROOMS or without a file: {sorted(found ^ set(ROOMS))}")
    return arrows


def reachable(start, arrows):
    """All rooms that a path of arrows leads to from start."""
    seen, todo = set(), [start]
    while todo:
        room = todo.pop()
        for a, b in arrows:
            if a == room and b not in seen:
                seen.add(b)
                todo.append(b)
    return seen


def reduced(arrows):
    """The arrows that no path of other arrows implies."""
    for room in ROOMS:
        if room in reachable(room, arrows):
            sys.exit(f"docs/rooms.py: includes lead from {room} back to itself")
    return [(a, b) for a, b in sorted(arrows) if b not in reachable(a, arrows - {(a, b)})]


def layered(arrows):
    """Layers of rooms from the top, and each arrow as a path through one node a layer: (layer, name) pairs."""
    depth = {room: 0 for room in ROOMS}
    for _ in ROOMS:
        for a, b in arrows:
            depth[b] = max(depth[b], depth[a] + 1)
    # A room that nothing includes is drawn just above what it includes.
    for room in ROOMS:
        if room not in {b for _, b in arrows} and any(a == room for a, _ in arrows):
            depth[room] = min(depth[b] for a, b in arrows if a == room) - 1
    layers = [[] for _ in range(max(depth.values()) + 1)]
    for room in ROOMS:
        layers[depth[room]].append(room)
    paths = []
    for a, b in arrows:
        path = [a]
        for layer in range(depth[a] + 1, depth[b]):
            path.append(f"{a} > {b} at {layer}")
            layers[layer].append(path[-1])
        paths.append(path + [b])
    return layers, paths


def ordered(layers, paths):
    """Sorts each layer by the mean place of its nodes' neighbours above and below; the places, 0 in the middle."""
    beside = {}
    for path in paths:
        for a, b in zip(path, path[1:]):
            beside.setdefault(a, []).append(b)
            beside.setdefault(b, []).append(a)

    def places(layer):
        x, at = {}, 0
        for node in layer:
            width = WIDTH if node in ROOMS else LANE
            x[node] = at + width / 2
            at += width + GAP_X
        return {node: value - (at - GAP_X) / 2 for node, value in x.items()}

    for sweep in range(12):
        numbers = range(len(layers)) if sweep % 2 == 0 else reversed(range(len(layers)))
        for number in numbers:
            other = number - 1 if sweep % 2 == 0 else number + 1
            if not 0 <= other < len(layers):
                continue
            x, own = places(layers[other]), places(layers[number])

            def mean(node):
                near = [x[n] for n in beside.get(node, []) if n in x]
                return sum(near) / len(near) if near else own[node]

            layers[number].sort(key=mean)
    return [places(layer) for layer in layers]


def svg():
    layers, paths = layered(reduced(includes()))
    x = ordered(layers, paths)
    wide = max(max(abs(v) for v in row.values()) for row in x) * 2 + WIDTH + 2 * MARGIN
    high = len(layers) * (HEIGHT + GAP_Y) - GAP_Y + 2 * MARGIN + LEGEND
    at = {node: (wide / 2 + place, MARGIN + number * (HEIGHT + GAP_Y))
          for number, row in enumerate(x) for node, place in row.items()}
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide:.0f} {high:.0f}" width="{wide:.0f}" '
        f'height="{high:.0f}" font-family="sans-serif" text-anchor="middle">',
        '<!-- Written by docs/rooms.py (make rooms). -->',
        '<defs><marker id="tip" viewBox="0 0 10 10" refX="10" refY="5" markerWidth="8" markerHeight="8" '
        'orient="auto"><path d="M0 1L10 5L0 9z" fill="#555"/></marker></defs>',
        '<rect width="100%" height="100%" fill="#fff"/>',
    ]
    for path in paths:
        px, py = at[path[0]]
        line = f"M{px:.0f} {py + HEIGHT:.0f}"
        py += HEIGHT
        for node in path[1:]:
            nx, ny = at[node]
            line += f"C{px:.0f} {py + GAP_Y / 2:.0f} {nx:.0f} {ny - GAP_Y / 2:.0f} {nx:.0f} {ny:.0f}"
            px, py = nx, ny
            if node not in ROOMS:
                py += HEIGHT
                line += f"V{py:.0f}"
        out.append(f'<path d="{line}" fill="none" stroke="#555" stroke-width="1.4" marker-end="url(#tip)"/>')
    for room, text in ROOMS.items():
        cx, top = at[room]
        out.append(f'<rect x="{cx - WIDTH / 2:.0f}" y="{top:.0f}" width="{WIDTH}" height="{HEIGHT}" rx="6" '
                   f'fill="{COLOURS[room.partition("/")[0]]}" stroke="#777"/>')
        out.append(f'<text x="{cx:.0f}" y="{top + 22:.0f}" font-size="16" font-weight="bold">{escape(room)}</text>')
        out.append(f'<text x="{cx:.0f}" y="{top + 41:.0f}" font-size="13">{escape(text)}</text>')
    out.append(f'<text x="{wide / 2:.0f}" y="{high - 14:.0f}" font-size="13" fill="#444">'
               'An arrow means: includes headers of. Arrows that a path of others implies are left out.</text>')
    return "\n".join(out + ["</svg>"]) + "\n"


def main():
    picture = svg()
    if sys.argv[1:] == ["--check"]:
        if not PICTURE.exists() or PICTURE.read_text() != picture:
            sys.exit("docs/rooms.svg is not the picture of the includes: make rooms")
        return
    PICTURE.write_text(picture)


main()
