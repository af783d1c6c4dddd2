#!/usr/bin/env python3
"""The machine loses its power at random moments of uploads and of reconstructions, and nothing that was acknowledged is lost.

cuts.py BUILD WORK [--disk strict|ext4] [--uploads N] [--jobs N] [--iterations N] [--seed S]

The state directory is on a file system that forgets what was not synced (unsynced.py), or on the kernel's ext4 on a
block device that does (a loop device over one file there). At a cut the disk takes nothing any more, then daemon and workers are
killed, the file system is unmounted, and what the cut left is mounted for the next daemon; some cuts come while it recovers.
What is done meanwhile and what must hold are those of kills.py: every acknowledged projection has its bytes, what was deleted is
gone, every job that had ended has its volumes with the bits they had, all others end with those of a run that nobody
disturbed. Prints the seed; exit status 1 when something did not hold.
"""
import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from typing import Optional

here = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, here)
import kills  # noqa: E402
from every import PATIENCE, Gone  # noqa: E402

IMAGE_BYTES = 64 << 20


def run(*words: str) -> str:
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, f"{' '.join(words)}: {done.stderr}"
    return done.stdout.strip()


def until(what: str, *words: str) -> None:
    """Runs a command until it succeeds: descriptors of processes that were killed are closed a little later."""
    end = time.monotonic() + PATIENCE
    while subprocess.run(words, capture_output=True).returncode != 0:
        assert time.monotonic() < end, what
        time.sleep(0.01)


class Disk:
    """What is mounted at a folder, and what a cut leaves of it."""

    def __init__(self, work: str, folder: str, ext4: bool) -> None:
        self.folder, self.ext4 = folder, ext4
        self.under = f"{work}/device" if ext4 else folder
        self.loop, self.on = "", True
        os.makedirs(folder)
        os.makedirs(self.under, exist_ok=True)
        options = ["--image", "image", str(IMAGE_BYTES)] if ext4 else []
        self.server = subprocess.Popen([sys.executable, f"{here}/unsynced.py", self.under, *options], stdin=subprocess.PIPE,
                                       stdout=subprocess.PIPE, text=True)
        self.expect("mounted")
        if ext4:
            run("mkfs.ext4", "-q", "-F", "-E", "nodiscard", "-J", "size=4", f"{self.under}/image")
            self.mount()
            os.rmdir(f"{folder}/lost+found")
            run("sync", "-f", folder)

    def expect(self, beginning: str = "") -> str:
        assert self.server.stdout is not None
        line = self.server.stdout.readline().strip()
        assert line.startswith(beginning) and line, f"unsynced.py: {line!r}"
        return line

    def say(self, command: str, beginning: str = "") -> str:
        assert self.server.stdin is not None
        self.server.stdin.write(command + "\n")
        self.server.stdin.flush()
        return self.expect(beginning)

    def mount(self) -> None:
        self.loop = run("losetup", "--show", "-f", f"{self.under}/image")
        run("mount", "-t", "ext4", "-o", "nodiscard,noatime,noinit_itable", self.loop, self.folder)

    def again(self) -> None:
        """When no process has anything open there any more."""
        self.on = False
        until(f"{self.folder} cannot be unmounted", "umount", self.folder)
        if self.ext4:
            run("losetup", "-d", self.loop)
            until(f"{self.under} cannot be unmounted", "umount", self.under)
        self.say("again", "mounted")
        if self.ext4:
            self.mount()
        self.on = True

    def end(self) -> None:
        until(f"{self.folder} cannot be unmounted", "umount", self.folder)
        if self.ext4:
            run("losetup", "-d", self.loop)
            until(f"{self.under} cannot be unmounted", "umount", self.under)
        assert self.server.stdin is not None
        self.server.stdin.close()
        self.server.wait()


class Machine(kills.Cell):
    """One state directory on a disk of its own, and all that was promised about it."""
    may_be_torn = True

    def __init__(self, build: str, work: str, rng: random.Random, ext4: bool, iterations: int) -> None:
        self.ext4 = ext4
        self.last = ""
        self.long = kills.long_jobs(iterations)
        super().__init__(build, work, rng)

    def prepare(self) -> None:
        self.disk = Disk(self.work, f"{self.work}/state", self.ext4)

    def kill(self, worker: bool) -> None:
        super().kill(False)

    def end_abruptly(self, process: "subprocess.Popen[bytes]") -> None:
        """Nobody gets an answer from the disk between the cut and the end of the processes."""
        self.last = self.disk.say(f"cut {self.rng.getrandbits(32)}")
        for pid in [*self.children(process.pid), process.pid]:
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                pass
        self.disk.say("killed", "off")
        self.counts["cuts"] += 1
        names = int(self.last.split()[0])
        self.counts["names open at a cut"] += names
        self.counts["writes open at a cut"] += int(self.last.split()[2])

    def restore(self) -> None:
        self.disk.again()


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("build")
    parser.add_argument("work")
    parser.add_argument("--disk", choices=["strict", "ext4"], default="strict")
    parser.add_argument("--uploads", type=int, default=70)
    parser.add_argument("--jobs", type=int, default=30)
    parser.add_argument("--iterations", type=int, default=300, help="of the jobs that are cut off")
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(10 ** 6))
    options = parser.parse_args()
    print(f"seed {options.seed}", flush=True)
    shutil.rmtree(options.work, ignore_errors=True)
    rng, done, begin = random.Random(options.seed), 0, time.monotonic()
    machine: Optional[Machine] = None
    rounds = ["upload"] * options.uploads + ["job"] * options.jobs
    rng.shuffle(rounds)
    try:
        machine = Machine(options.build, options.work, rng, options.disk == "ext4", options.iterations)
        for kind in rounds:
            machine.upload_round() if kind == "upload" else machine.job_round()
            done += 1
        machine.end()
        machine.disk.end()
    except (AssertionError, Gone, kills.Broken) as error:
        print(f"WRONG at round {done} of seed {options.seed} in {options.work}: {error!r}; the last cut: {machine and machine.last}",
              flush=True)
        if machine is not None:
            machine.daemon.process.kill()
            machine.daemon.process.wait()
            if machine.disk.on:
                shutil.copytree(f"{options.work}/state", f"{options.work}/left", dirs_exist_ok=True)
                machine.disk.end()
        return 1
    counts = ", ".join(f"{count} {what}" for what, count in sorted(machine.counts.items()))
    print(f"{options.disk}: {done} cuts in {time.monotonic() - begin:.0f} s; {counts}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
