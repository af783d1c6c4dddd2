#!/usr/bin/env python3
"""A worker for simulations of a fleet: cbct-worker computes the job, which is small, but the daemon hears of each iteration and of the end
only when they would have come of the job that it stands for.

That job is told by the number of SART iterations, 0 of one without: PACED_SECONDS has the seconds of each, "N:SECONDS,...", others take
none. A worker that is asked to yield meanwhile leaves at once, and a job that comes back takes what was left of its time.

PACED_WORKER is the path of cbct-worker; the arguments are a worker's.
"""
import json
import os
import select
import socket
import subprocess
import sys
import time

BUSY = -11  # ERR_BUSY of core/error.h
PACKET = 1 << 20


class Paced:
    def __init__(self):
        at = sys.argv.index("--socket") + 1
        self.daemon = socket.socket(fileno=int(sys.argv[at]))
        self.worker, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for one in (self.worker, theirs):
            one.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2 * PACKET)
        arguments = sys.argv[1:at] + [str(theirs.fileno())] + sys.argv[at + 1:]
        self.process = subprocess.Popen([os.environ["PACED_WORKER"]] + arguments, pass_fds=[theirs.fileno()])
        theirs.close()
        self.seconds = {int(n): float(s) for n, s in (pair.split(":") for pair in os.environ["PACED_SECONDS"].split(","))}
        self.left = {}  # job: seconds
        self.job, self.began, self.iterations, self.steps = "", 0.0, 0, 0
        self.due, self.waiting = 0.0, []  # what the worker has said, with the time when the daemon hears of it

    def from_daemon(self, packet):
        message = json.loads(packet)
        if message["kind"] == "start":
            self.iterations = (message["request"].get("sart") or {}).get("iterations", 0)
            self.job, self.began = message["job"], time.monotonic()
            self.left.setdefault(self.job, self.seconds.get(self.iterations, 0.0))
            self.due = self.began
        elif message["kind"] in ("yield", "cancel", "quit") and self.waiting and json.loads(self.waiting[-1][1])["kind"] == "ended":
            self.left[self.job] -= time.monotonic() - self.began
            self.tell(dict(json.loads(self.waiting[-1][1]), code=BUSY, iteration=0, text="it made room"))
            self.waiting = []
            if message["kind"] != "quit":
                return
        self.worker.send(packet)

    def tell(self, message):
        self.daemon.send(json.dumps(message).encode())

    def from_worker(self, packet):
        message = json.loads(packet)
        if message["kind"] == "alive":
            # The end that is held back is a step that never ends, to the daemon's watchdog.
            self.steps += 1
            self.tell(dict(message, steps=message.get("steps", 0) + self.steps))
        else:
            left = self.left.get(self.job, 0.0)
            if message["kind"] == "row":
                self.due = self.began + left * message["iteration"] / max(1, self.iterations)
            elif message["kind"] == "ended" and message.get("code", 0) == 0:
                self.due = self.began + left
            self.waiting.append((self.due, packet))

    def speak(self):
        """Says what is due; seconds until the next, None: nothing waits."""
        while self.waiting and self.waiting[0][0] <= time.monotonic():
            _, packet = self.waiting.pop(0)
            self.daemon.send(packet)
            if json.loads(packet)["kind"] == "ended":
                self.left.pop(self.job, None)
        return max(0.0, self.waiting[0][0] - time.monotonic()) if self.waiting else None

    def run(self):
        while True:
            wait = self.speak()
            for one in select.select([self.daemon, self.worker], [], [], wait)[0]:
                packet = one.recv(PACKET)
                if not packet:
                    self.process.terminate()
                    return self.process.wait()
                (self.from_daemon if one is self.daemon else self.from_worker)(packet)


sys.exit(Paced().run())
