#!/usr/bin/env python3
"""Jobs whose end finds no room: the record of it is written, its commit is not. Another job is posted as soon as there is room again, and the
daemon is killed before the end is tried once more. It must start, and every job that was acknowledged must succeed: the two jobs' events
must not have one number.

usage: full_disk.py BUILD FOLDER SCAN      the state directory is FOLDER/state, on a small disk of its own
"""
import http.client
import json
import os
import pathlib
import subprocess
import sys
import time

ROUNDS, ENDS = 60, 25  # at most so many, and so many that met a full disk
LEFT = (4096, 8192, 12288, 16384, 24576, 36864)  # bytes
GRID = {"size": [24] * 3, "spacing_mm": [2] * 3}


class Daemon:
    def __init__(self, build, folder):
        self.out, self.err = folder.parent / "full.out", folder.parent / "full.err"
        self.command = [f"{build}/cbctd", "--listen", "127.0.0.1:0", "--state-dir", str(folder / "state"), "--backend", "cpu"]

    def start(self):
        with open(self.out, "w") as out, open(self.err, "w") as err:
            self.process = subprocess.Popen(self.command, stdout=out, stderr=err)
        while "listening on" not in self.out.read_text():
            if self.process.poll() is not None:
                sys.exit(f"expected: a daemon that starts: {self.err.read_text()[-400:]}")
            time.sleep(0.01)
        self.port = int(self.out.read_text().split(":")[-1])

    def ask(self, method, path, document=None):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        connection.request(method, path, None if document is None else json.dumps(document), {"Content-Type": "application/json"} if document else {})
        reply = connection.getresponse()
        text = reply.read()
        connection.close()
        return reply.status, json.loads(text) if text[:1] == b"{" else text.decode()

    def kill(self):
        self.process.kill()
        self.process.wait()


def fill(path, left):
    with open(path, "wb", buffering=0) as file:
        for size in (1 << 20, 4096):
            try:
                while True:
                    file.write(b"x" * size)
            except OSError:
                pass
        file.truncate(max(0, os.fstat(file.fileno()).st_size - left))


def has_met_it(daemon):
    end = time.monotonic() + 1.2
    while time.monotonic() < end:
        if "recorded yet: the disk of the catalogue" in daemon.err.read_text():
            return True
        time.sleep(0.002)
    return False


def main():
    build, folder, scan = sys.argv[1], pathlib.Path(sys.argv[2]), sys.argv[3]
    daemon, jobs, met = Daemon(build, folder), [], 0
    document = {"scan": scan, "grid": GRID, "fdk": {}}
    daemon.start()
    try:
        for round in range(ROUNDS):
            jobs.append(daemon.ask("POST", "/v1/jobs", document))
            fill(folder / "fill", LEFT[round % len(LEFT)])
            met += has_met_it(daemon)
            (folder / "fill").unlink()
            jobs.append(daemon.ask("POST", "/v1/jobs", document))
            daemon.kill()
            if met == ENDS:
                break
            daemon.start()
        else:
            daemon.kill()
        daemon.start()
        print(f"  ends that found no room = {met} of {round + 1}")
        for status, job in jobs:
            while status == 202 and daemon.ask("GET", f"/v1/jobs/{job['id']}?wait=60")[1]["state"] in ("queued", "running"):
                pass
            if status not in (202, 507) or (status == 202 and daemon.ask("GET", f"/v1/jobs/{job['id']}")[1]["state"] != "succeeded"):
                sys.exit(f"expected: a job that succeeds, got {status} {job}")
        if daemon.ask("GET", "/v1/quarantine")[1]["entries"] != []:
            sys.exit("expected: nothing in quarantine")
    finally:
        daemon.kill()


main()
