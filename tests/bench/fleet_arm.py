#!/usr/bin/env python3
"""FDK on a server while a cart's arm turns: the cart's daemon gets a detector's views at its rate, has no device, and sends each on to
a server's daemon, whose worker reconstructs them as they come. Prints the processor time of each process for a view, and how long after
the last view the volume was kept. All of it is on this machine, and its processors are shared by both sides.

usage: fleet_arm.py BUILD FOLDER DATABASE-ADDRESS [--views N] [--rate R] [--grid N] [--backend NAME] [--threads N]
backend and threads are those of the server's worker.
"""
import argparse
import array
import json
import math
import os
import pathlib
import random
import subprocess
import sys
import time

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent / "http"))
from fleet_host import Host, wait_for

COLUMNS, ROWS = 1240, 960
PIXEL, SOURCE, DETECTOR, AIR = 0.308, 620, 1100, 60000  # mm, counts
TICK = os.sysconf("SC_CLK_TCK")


def children(process):
    """Of any of its threads."""
    return [int(pid) for file in pathlib.Path(f"/proc/{process}/task").glob("*/children") for pid in file.read_text().split()]


def seconds_of(process):
    """Of the processor; None where it has gone."""
    try:
        fields = pathlib.Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return None
    return (int(fields[11]) + int(fields[12])) / TICK


def name_of(process):
    try:
        return " ".join(pathlib.Path(f"/proc/{process}/cmdline").read_text().split("\0")[:2]).strip()
    except OSError:
        return ""


def written_views(file, count):
    """A cylinder of water amid the arm's way, with the noise of its counts: what a worker looks for in views that show nothing real would
    take longer than its reconstruction. The rows are drawn from a few."""
    across = [SOURCE * math.sin(math.atan((c - (COLUMNS - 1) / 2) * PIXEL / DETECTOR)) for c in range(COLUMNS)]
    counts = [AIR * math.exp(-0.02 * 2 * math.sqrt(max(0, 90**2 - x * x))) for x in across]
    draw = random.Random(1)
    rows = [array.array("H", [int(min(65535, n + math.sqrt(n) * draw.gauss(0, 1))) for n in counts]).tobytes() for _ in range(64)]
    for _ in range(count):
        file.write(b"".join(draw.choices(rows, k=ROWS)))


def main():
    parser = argparse.ArgumentParser()
    for name in ("build", "folder", "database"):
        parser.add_argument(name)
    parser.add_argument("--views", type=int, default=240)
    parser.add_argument("--rate", type=float, default=30)
    parser.add_argument("--grid", type=int, default=32)
    parser.add_argument("--backend", default="cpu")
    parser.add_argument("--threads", default="1")
    options = parser.parse_args()
    options.folder = pathlib.Path(options.folder)
    options.folder.mkdir(parents=True, exist_ok=True)
    nothing = options.folder / "no-device"
    nothing.write_text("#!/bin/sh\nexec sleep 86400\n")
    nothing.chmod(0o755)
    with open(options.folder / "all", "wb") as file:
        written_views(file, options.views)
    size = 2 * COLUMNS * ROWS  # bytes
    hosts = [Host(options, "arm", "server", True, ["--backend", options.backend, "--threads", options.threads]),
             Host(options, "arm", "cart", False, ["--worker", str(nothing)])]
    server, cart = hosts
    try:
        for host in hosts:
            host.start()
        wait_for(lambda: server.ask("GET", "/readyz")[0] == 200, 60, "the server is ready")
        spacing = 190 / options.grid
        scan = cart.json("POST", "/v1/scans", {
            "name": "arm", "detector": {"columns": COLUMNS, "rows": ROWS, "pixel_mm": [PIXEL, PIXEL]},
            "projections": {"count": options.views, "sample": "uint16", "quantity": "intensity", "air": AIR},
            "geometry": {"kind": "circular", "source_to_isocentre_mm": SOURCE, "source_to_detector_mm": DETECTOR, "first_angle_deg": 0,
                         "angle_step_deg": 360 / options.views}})["id"]
        job = cart.json("POST", "/v1/jobs", {"scan": scan, "grid": {"size": [options.grid] * 3, "spacing_mm": [spacing] * 3}, "fdk": {}, "emit": ["fdk"]})["id"]
        before = {host.name: seconds_of(host.process.pid) for host in hosts}
        used = {}  # seconds of each process, at its last look
        began = time.monotonic()
        arm = subprocess.Popen([f"{options.build}/acquire", str(cart.port), scan, job, str(options.folder / "all"), str(options.views), str(size),
                                str(options.rate), "2"], stdout=subprocess.PIPE, text=True)
        last, stored = began, 0
        while True:
            document = cart.json("GET", f"/v1/jobs/{job}")
            for host in hosts:
                for process in children(host.process.pid):
                    used[host.name, process, name_of(process)] = seconds_of(process) or used.get((host.name, process, name_of(process)), 0.0)
            if document["views"]["received"] > stored:
                last, stored = time.monotonic(), document["views"]["received"]
            if document["state"] in ("succeeded", "failed", "cancelled"):
                break
            time.sleep(0.1)
        ended = time.monotonic()
        result = json.loads(arm.communicate()[0])
        each = 1e3 / options.views

        def used_by(host, program):
            return sum(seconds for (name, _, command), seconds in used.items() if name == host and program in command)

        rows = {"the cart's daemon receives it": seconds_of(cart.process.pid) - before["cart"],
                "its process sends it on": used_by("cart", "remote"),
                "the server's daemon receives it": seconds_of(server.process.pid) - before["server"],
                "the server's worker reconstructs it": used_by("server", "worker")}
        print(f"{options.views} views of {COLUMNS} x {ROWS} uint16 at {options.rate:g} a second ({options.rate * size / 1e6:.0f} MB/s), {options.grid}^3: "
              f"{document['state']} on {document['device']}, {options.threads} threads, stages {document['timings']}")
        print(f"  the last view was stored on the cart after {last - began:.1f} s (the arm took {options.views / options.rate:.1f} s), the job ended {ended - last:.1f} s later")
        print(f"  a PUT to the cart: {result['put_ms']}; sent late: {result['late_ms']}")
        for what, seconds in rows.items():
            print(f"  {what}: {each * seconds:.2f} ms of a processor a view")
        print(f"  without the reconstruction {each * sum(list(rows.values())[:3]):.2f} ms, of {1e3 / options.rate:.1f} ms between two views")
        return document["state"] != "succeeded"
    finally:
        for host in hosts:
            if host.process is not None:
                host.kill()
        (options.folder / "all").unlink()


sys.exit(main())
