#!/usr/bin/env python3
"""What a long list of jobs and what checkpoints cost the daemon and its worker, in processor time and by the clock.

daemon_costs.py BUILD WORK jobs [COUNT]           the start with COUNT (10,000) jobs in the catalogue, half of them
                                                  cancelled, and lists of them
daemon_costs.py BUILD WORK checkpoints [PAIRS]    a job without and with many checkpoints, in turn; processor time of its
                                                  worker, so that it may be asked of a busy machine
"""
import http.client
import json
import os
import re
import shutil
import subprocess
import sys
import time
from typing import Dict, Optional, Tuple

SCAN = {
    "detector": {"columns": 8, "rows": 8, "pixel_mm": [4, 4]},
    "projections": {"count": 4, "sample": "float32", "quantity": "line_integral"},
    "geometry": {"kind": "circular", "source_to_isocentre_mm": 600, "source_to_detector_mm": 1000,
                 "first_angle_deg": 0, "angle_step_deg": 90},
}
ITERATIONS: Dict[str, object] = {"grid": {"size": [128, 128, 128], "spacing_mm": [1.2, 1.2, 1.2]}, "fdk": {},
              "sart": {"iterations": 30, "subsets": 10}, "tv": None}
HEAD = ("--phantom head --scale 60 --density 0.02 --views 90 --arc 360 --columns 96 --rows 72 --pixel 3 "
        "--source-to-isocentre 620 --source-to-detector 1100").split()


def processor(process: int) -> float:
    """Seconds that all threads of a process have had."""
    fields = open(f"/proc/{process}/stat").read().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Daemon:
    def __init__(self, build: str, work: str, *options: str) -> None:
        begun = time.monotonic()
        with open(f"{work}/out", "wb") as out, open(f"{work}/err", "ab") as err:
            self.process = subprocess.Popen(
                [f"{build}/cbctd", "--listen", "127.0.0.1:0", "--state-dir", f"{work}/state", "--backend", "cpu",
                 "--threads", "1", *options], stdout=out, stderr=err, env=dict(os.environ, OMP_NUM_THREADS="1"))
        while not (text := open(f"{work}/out").read()).endswith("\n"):
            assert self.process.poll() is None, open(f"{work}/err").read()
            time.sleep(0.002)
        self.url = text.split()[-1]
        self.connection = http.client.HTTPConnection("127.0.0.1", int(self.url.rstrip("/").rsplit(":", 1)[1]))
        while self.ask("GET", "/readyz")[0] != 200:
            time.sleep(0.002)
        self.ready = time.monotonic() - begun

    def ask(self, method: str, path: str, document: Optional[object] = None) -> Tuple[int, bytes]:
        body, headers = None, {}
        if document is not None:
            body, headers = json.dumps(document).encode(), {"Content-Type": "application/json"}
        self.connection.request(method, path, body, headers)
        reply = self.connection.getresponse()
        return reply.status, reply.read()

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait()


def jobs(build: str, work: str, count: int) -> None:
    daemon = Daemon(build, work)
    scan = json.loads(daemon.ask("POST", "/v1/scans", SCAN)[1])["id"]
    job = {"scan": scan, "grid": {"size": [8, 8, 8], "spacing_mm": [4, 4, 4]}, "fdk": {}}
    for i in range(count):
        status, reply = daemon.ask("POST", "/v1/jobs", job)
        assert status == 202, reply
        if i % 2 == 1:
            daemon.ask("DELETE", f"/v1/jobs/{json.loads(reply)['id']}")
    daemon.stop()
    for _ in range(3):
        daemon = Daemon(build, work)
        line = f"{count} jobs: ready after {daemon.ready:.2f} s, {processor(daemon.process.pid):.2f} s of processor"
        for path in ("/v1/jobs", "/v1/jobs?limit=1000", "/v1/jobs?state=cancelled"):
            used, begun = processor(daemon.process.pid), time.monotonic()
            for _ in range(20):
                assert daemon.ask("GET", path)[0] == 200
            line += (f"; {path} {50 * (time.monotonic() - begun):.1f} ms, "
                     f"{50 * (processor(daemon.process.pid) - used):.1f} ms of processor")
        print(line, flush=True)
        daemon.stop()


def one_job(build: str, work: str, seconds: float) -> None:
    shutil.rmtree(f"{work}/state", ignore_errors=True)
    daemon = Daemon(build, work, "--checkpoint-seconds", str(seconds))
    scan = subprocess.run([f"{build}/cbct", "upload", "--quiet", "--url", daemon.url, f"{work}/scan"], check=True,
                          capture_output=True, text=True).stdout.strip()
    worker = int(subprocess.run(["pgrep", "-P", str(daemon.process.pid), "cbct-worker"], check=True,
                                capture_output=True, text=True).stdout.split()[0])
    asked: Dict[str, object] = {**ITERATIONS, "scan": scan}
    used = processor(worker)
    job = json.loads(daemon.ask("POST", "/v1/jobs", asked)[1])
    while job["state"] not in ("succeeded", "failed"):
        job = json.loads(daemon.ask("GET", f"/v1/jobs/{job['id']}?wait=60")[1])
    used = processor(worker) - used
    made = re.search(rb"cbctd_checkpoints_total (\d+)", daemon.ask("GET", "/metrics")[1])
    daemon.stop()
    print(f"--checkpoint-seconds {seconds:g}: {job['state']}, {used:.2f} s of processor, "
          f"{int(made[1]) if made else 0} checkpoints", flush=True)


def main() -> int:
    build, work, what = sys.argv[1:4]
    shutil.rmtree(work, ignore_errors=True)
    os.makedirs(work)
    if what == "jobs":
        jobs(build, work, int(sys.argv[4]) if len(sys.argv) > 4 else 10000)
        return 0
    subprocess.run([f"{build}/cbct", "simulate", *HEAD, "-o", f"{work}/scan"], check=True, stdout=subprocess.DEVNULL)
    for _ in range(int(sys.argv[4]) if len(sys.argv) > 4 else 3):
        one_job(build, work, 3600)
        one_job(build, work, 0.5)
    return 0


if __name__ == "__main__":
    sys.exit(main())
