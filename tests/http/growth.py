#!/usr/bin/env python3
"""Small scans in and out of a daemon, and what it and its worker keep of each: memory, descriptors, threads.

growth.py BUILD WORK [--scans N] [--seconds S] [--backend cpu|cuda]

N scans are posted, reconstructed, looked at by most routes and downloaded, spread over S seconds. The newest KEPT stay,
each older one is deleted with its job, so that the daemon has as much to remember after the N-th as after the KEPT-th.
WORK/samples.csv has a row after each scan. A line is fitted to each quantity over the number of scans, after a warm-up;
exit status 1 where one rises by more than its bound.

The warm-up: WARM scans, since the catalogue keeps the last 1,000 removals of jobs (store/tables.c), and its database
grows by them until then. A run of fewer than about twice that many scans is judged by
descriptors and threads, of which not one may come, by what is in use of a card's memory, which may not rise, and by the
worker's live bytes.

The bounds. Live bytes (build/live_bytes.so counts them): 16 a scan, since the smallest block that malloc gives has 24,
so that one block left behind by each scan would be more. Live blocks: one in ten scans. Resident memory: 100 bytes a
scan, a page in 40 scans, which is the allocator's slack.
"""
import argparse
import csv
import http.client
import json
import os
import random
import re
import shutil
import struct
import sys
import time
from typing import Dict, List, Optional, Tuple

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))
from every import Daemon  # noqa: E402

VIEWS, COLUMNS, ROWS, KEPT = 8, 16, 16, 20
SCAN = {
    "detector": {"columns": COLUMNS, "rows": ROWS, "pixel_mm": [4, 4]},
    "projections": {"count": VIEWS, "sample": "float32", "quantity": "line_integral"},
    "geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000,
                 "first_angle_deg": 0, "angle_step_deg": 360 / VIEWS},
    "patient": {"position": "HFS"},
}
JOB = {"grid": {"size": [16, 16, 16], "spacing_mm": [3, 3, 3]}, "fdk": {}, "sart": {"iterations": 1}, "emit": ["fdk"]}
BOUNDS = {"live_bytes": 16.0, "live_blocks": 0.1, "rss": 100.0}
WARM = 1000 + 2 * KEPT


class Growing(Daemon):
    def __init__(self, build: str, work: str, backend: str) -> None:
        self.work = work
        os.environ["CBCT_LIVE_BYTES"] = f"{work}/live"
        os.environ["LD_PRELOAD"] = f"{build}/live_bytes.so"
        super().__init__(build, work, None, backend=backend)
        del os.environ["LD_PRELOAD"]
        self.connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)

    def call(self, method: str, path: str, body: Optional[bytes] = None, headers: Dict[str, str] = {}) -> bytes:
        self.connection.request(method, path, body, headers)
        reply = self.connection.getresponse()
        data = reply.read()
        assert 200 <= reply.status < 300, f"{method} {path}: {reply.status} {data[:300]!r}"
        return data

    def pids(self) -> Dict[str, int]:
        """The daemon and its worker."""
        pid = self.process.pid
        children = [int(child) for task in os.listdir(f"/proc/{pid}/task")
                    for child in open(f"/proc/{pid}/task/{task}/children").read().split()]
        assert len(children) == 1, f"one worker, not {children}"
        return {"cbctd": pid, "worker": children[0]}

    def sample(self) -> Dict[str, int]:
        row = {}
        for name, pid in self.pids().items():
            fields = dict(line.split(":", 1) for line in open(f"/proc/{pid}/smaps_rollup") if ":" in line)
            row[f"{name}.rss"] = int(fields["Rss"].split()[0]) * 1024
            row[f"{name}.pss"] = int(fields["Pss"].split()[0]) * 1024
            row[f"{name}.anonymous"] = int(fields["Anonymous"].split()[0]) * 1024
            row[f"{name}.descriptors"] = len(os.listdir(f"/proc/{pid}/fd"))
            row[f"{name}.threads"] = len(os.listdir(f"/proc/{pid}/task"))
            bytes_, blocks = struct.unpack("<2q", open(f"{self.work}/live.{pid}", "rb").read(16))
            row[f"{name}.live_bytes"], row[f"{name}.live_blocks"] = bytes_, blocks
        cards = re.findall(r"^cbctd_gpu_memory_used_bytes.* (\S+)$", self.call("GET", "/metrics").decode(), re.M)
        if cards:
            row["cards.device_bytes"] = sum(int(float(card)) for card in cards)
        return row


def in_and_out(daemon: Growing, data: bytes) -> Tuple[str, str]:
    kind = {"Content-Type": "application/json"}
    key = {**kind, "Idempotency-Key": f"key-{random.getrandbits(64):x}"}
    scan = json.loads(daemon.call("POST", "/v1/scans", json.dumps(SCAN).encode(), key))["id"]
    daemon.call("PUT", f"/v1/scans/{scan}/projections", data)
    job = json.loads(daemon.call("POST", "/v1/jobs", json.dumps({**JOB, "scan": scan}).encode(), kind))["id"]
    end = time.monotonic() + 60
    while True:
        document = json.loads(daemon.call("GET", f"/v1/jobs/{job}?wait=20"))
        if document["state"] == "succeeded":
            break
        assert document["state"] in ("queued", "running") and time.monotonic() < end, document
    assert len(daemon.call("GET", f"/v1/jobs/{job}/volumes/final?format=raw")) == 4 * 16 ** 3
    for path in ("?format=dicom", "?format=nifti.gz", "/slice?axis=z&index=8"):
        daemon.call("GET", f"/v1/jobs/{job}/volumes/fdk{path}")
    for path in (f"/v1/scans/{scan}", "/v1/scans", "/v1/jobs", f"/v1/jobs/{job}/volumes", f"/v1/jobs/{job}/events",
                 f"/v1/jobs/{job}/stream", "/metrics", "/readyz", "/v1/devices", "/plain"):
        daemon.call("GET", path)
    notes = daemon.call("GET", f"/v1/jobs/{job}/annotations")
    daemon.call("PUT", f"/v1/jobs/{job}/annotations", notes, {**kind, "If-Match": "*"})
    return scan, job


def slope(xs: List[float], ys: List[float]) -> Tuple[float, float]:
    """Least squares, and the slope's standard error."""
    count, mean_x, mean_y = len(xs), sum(xs) / len(xs), sum(ys) / len(ys)
    square = sum((x - mean_x) ** 2 for x in xs)
    rise = sum((x - mean_x) * (y - mean_y) for x, y in zip(xs, ys)) / square
    rest = sum((y - mean_y - rise * (x - mean_x)) ** 2 for x, y in zip(xs, ys))
    return rise, (rest / max(count - 2, 1) / square) ** 0.5


def judge(path: str) -> int:
    """How many quantities of the samples grow."""
    samples = list(csv.DictReader(open(path)))
    whole = len(samples) >= 2 * WARM - 100
    warm, wrong = WARM if whole else max(KEPT + 1, len(samples) // 4), 0
    rows = samples[warm:]
    print(f"{len(rows)} scans after a warm-up of {warm}:")
    for column in list(samples[0])[2:]:
        program, what = column.split(".")
        ys = [float(row[column]) for row in rows]
        rise, error = slope([float(row["scans"]) for row in rows], ys)
        verdict = ""
        if what in ("descriptors", "threads", "device_bytes"):
            if ys[-1] > max(ys[:max(1, len(ys) // 4)]):
                verdict = "RISES"
        elif what in BOUNDS and (whole or (program, what) == ("worker", "live_bytes")) and rise > BOUNDS[what]:
            verdict = f"MORE THAN {BOUNDS[what]:g}"
        wrong += verdict != ""
        print(f"  {column:20} {ys[0]:10.0f} .. {ys[-1]:10.0f}, {rise:+9.3f} +- {error:.3f} a scan  {verdict}")
    print(f"{wrong} quantities grow")
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("build")
    parser.add_argument("work")
    parser.add_argument("--scans", type=int, default=2000)
    parser.add_argument("--seconds", type=float, default=0, help="spread over that")
    parser.add_argument("--backend", default="cpu")
    options = parser.parse_args()
    shutil.rmtree(options.work, ignore_errors=True)
    os.makedirs(options.work)
    data = struct.pack(f"<{VIEWS * COLUMNS * ROWS}f", *(random.random() for _ in range(VIEWS * COLUMNS * ROWS)))
    daemon = Growing(options.build, options.work, options.backend)
    kept: List[Tuple[str, str]] = []
    begin = time.monotonic()
    try:
        with open(f"{options.work}/samples.csv", "w", newline="") as file:
            writer = None
            for number in range(1, options.scans + 1):
                kept.append(in_and_out(daemon, data))
                if len(kept) > KEPT:
                    scan, job = kept.pop(0)
                    daemon.call("DELETE", f"/v1/jobs/{job}")
                    daemon.call("DELETE", f"/v1/scans/{scan}")
                time.sleep(max(0.0, begin + number * options.seconds / options.scans - time.monotonic()))
                row = {"scans": number, "seconds": round(time.monotonic() - begin), **daemon.sample()}
                if writer is None:
                    writer = csv.DictWriter(file, list(row))
                    writer.writeheader()
                writer.writerow(row)
                file.flush()
    finally:
        daemon.connection.close()
        status = daemon.stop()
    assert status == 0, f"the daemon ended with {status}"
    print(f"{options.scans} scans in {time.monotonic() - begin:.0f} s")
    return judge(f"{options.work}/samples.csv") > 0


if __name__ == "__main__":
    sys.exit(main())
