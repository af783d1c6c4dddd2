"""The study's experiments through a daemon: `experiments.py --results DIR` starts cbctd, posts the scans, asks for the jobs,
fetches the volumes that they keep, compares them with the truth and leaves NAME.DEVICE.json for each row of RUNS, with
pictures of it in NAME.DEVICE.npz. report.py makes one document of a folder of these.

A new experiment is a row of SCANS or RUNS.
"""

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field

import numpy as np

HERE = os.path.dirname(os.path.abspath(__file__))
TOP = os.path.dirname(os.path.dirname(HERE))
sys.path.insert(0, os.path.join(TOP, "clients", "python"))

import cbctd  # noqa: E402
import objects  # noqa: E402

CUBE, WATER = objects.CUBE_MM, objects.WATER


@dataclass(frozen=True)
class Scan:
    """What is scanned, and how. kind: voxels and exact are the head on side^3 voxels, projected through its voxels or by
    exact integrals; anatomy is a slab of the real CT volume; arm is the whole of it, at half its size so that the
    detector holds it, through a C-arm's matrices."""

    kind: str
    side: int
    views: int
    pixels: int
    pixel_mm: float
    noise: bool = False
    small: bool = True


def _shadow(times, pixels):
    """Pixel in mm of a detector so many times as wide as the shadow of the cube's side at the isocentre."""
    return times * CUBE * objects.SOURCE_TO_DETECTOR / objects.SOURCE_TO_ISOCENTRE / pixels


SCANS = {
    "fig5": Scan("voxels", 64, 100, 169, _shadow(1.2, 169)),
    "fig5-exact": Scan("exact", 64, 100, 169, _shadow(1.2, 169)),
    "fig7": Scan("voxels", 64, 26, 85, _shadow(1.2, 85), noise=True),
    "fig7-exact": Scan("exact", 64, 26, 85, _shadow(1.2, 85), noise=True),
    "table1": Scan("voxels", 32, 26, 43, 6.88),
    "fig8": Scan("voxels", 256, 100, 559, 0.529, small=False),
    "fig9": Scan("anatomy", 256, 100, 339, 0.713, small=False),
    "fig11": Scan("anatomy", 256, 100, 339, 0.713, noise=True, small=False),
    "arm": Scan("arm", 0, 248, 616, 0.616, noise=True, small=False),
    "arm-binned": Scan("arm", 0, 248, 308, 1.232, noise=True, small=False),
}
SLAB = 33  # slices of the anatomy


@dataclass(frozen=True)
class Run:
    """A job. recipe: as POST /v1/jobs takes it; a TV's unit of "maximum/64" becomes that of the truth. shown: the kept
    volumes whose pictures are kept, too; curve: every iteration is kept, so that its error is known."""

    name: str
    scan: str
    title: str
    recipe: dict
    shown: tuple
    curve: bool = False
    times: int = 1  # that it is run; the fastest counts
    processors: bool = False  # also on one thread and on all threads of the processor
    part: str = "paper"  # of the report: paper, faster, better, stop
    twin: str = ""  # of a job that ends by itself: the run with a number of iterations that shows where it should have ended


RAM_LAK = {"fdk": {"window": "ram-lak"}}
PAPER_TV = {"method": "gradient", "alpha": 0.1, "step": 0.1, "iterations": 10, "unit": "maximum/64", "after": "sart"}
ONE_STEP = {**PAPER_TV, "iterations": 1}


def _sart(iterations, subsets="views", **more):
    return {"sart": {"iterations": iterations, "subsets": subsets, **more}}


def _auto(**more):
    return {"sart": {"iterations": "auto", "max_iterations": 30, **more}}


def _proximal(alpha, iterations=20):
    return {"tv": {"method": "proximal", "alpha": alpha, "iterations": iterations, "unit": "maximum/64", "after": "sart"}}


FIG5 = ("fdk", 3, 20, 35, 50)
FIG7 = (3, 20, 35, 50)
FIG9 = (1, 5, 10, 20, 40, 100, 200)
FIG11 = (5, 20, 100, 200)

RUNS = [
    # ---- the study's own ----
    Run("fig5", "fig5", "FDK, SART view by view", {**RAM_LAK, **_sart(50)}, FIG5, curve=True),
    Run("fig7-plain", "fig7", "SART view by view", _sart(50, nonnegative=False), FIG7, curve=True),
    Run("fig7-tv", "fig7", "SART view by view, TV", {**_sart(50), "tv": PAPER_TV}, FIG7, curve=True),
    Run("table1", "table1", "SART view by view", _sart(20), (20,), times=3, processors=True),
    Run("table1-at-once", "table1", "SART, all views at once", _sart(20, 1), (20,), times=3, processors=True),
    Run("fig8", "fig8", "SART view by view", _sart(50), (5, 10, 50)),
    Run("fig9", "fig9", "SART view by view", _sart(200), FIG9),
    Run("fig11-plain", "fig11", "SART view by view", _sart(200), FIG11),
    Run("fig11-tv", "fig11", "SART view by view, TV", {**_sart(200), "tv": ONE_STEP}, FIG11),
    # ---- to the same error in fewer iterations ----
    Run("views", "fig5", "view by view", {**RAM_LAK, **_sart(100)}, (50, 100), True, part="faster"),
    Run("at-once", "fig5", "all views at once", {**RAM_LAK, **_sart(100, 1)}, (50, 100), True, part="faster"),
    Run("at-once-momentum", "fig5", "all views at once, momentum", {**RAM_LAK, **_sart(50, 1, momentum=True)}, (50,), True, part="faster"),
    Run("ten", "fig5", "10 subsets", {**RAM_LAK, **_sart(50, 10)}, (20, 50), True, part="faster"),
    Run("ten-momentum", "fig5", "10 subsets, momentum", {**RAM_LAK, **_sart(100, 10, momentum=True)}, (20, 50, 100), True, part="faster"),
    Run("cgls", "fig5", "conjugate gradients", {**RAM_LAK, "cgls": {"iterations": 30}}, (15, 30), True, part="faster"),
    Run("fista", "fig5", "FISTA", {**RAM_LAK, "fista": {"iterations": 50}}, (50,), True, part="faster"),
    Run("exact-tv", "fig5-exact", "FDK hann, 10 subsets, TV", {"fdk": {}, **_sart(10, 10), "tv": PAPER_TV}, ("fdk", 5, 10), True, part="better"),
    # ---- nearer to the object ----
    Run("fig7-ordered", "fig7", "13 subsets", _sart(50, 13), (50,), True, part="better"),
    Run("fig7-proximal", "fig7", "13 subsets, momentum, proximal TV", {**_sart(20, 13, momentum=True), **_proximal(2)}, (20,), True, part="better"),
    Run("fig7-fista", "fig7", "FISTA, proximal TV", {"fista": {"iterations": 60}, **_proximal(25)}, (60,), True, part="better"),
    Run("fig7-noise", "fig7", "FISTA, weights of the noise, proximal TV", {"fista": {"iterations": 40, "weights": "noise"}, **_proximal(25)}, (40,), True, part="better"),
    Run("fig7-counts", "fig7", "FISTA, weights of counts, proximal TV", {"fista": {"iterations": 40, "weights": "counts"}, **_proximal(25)}, (40,), True, part="better"),
    Run("fig7-exact-tv", "fig7-exact", "SART view by view, TV", {**_sart(50), "tv": PAPER_TV}, (50,), True, part="better"),
    Run("fig7-exact-fista", "fig7-exact", "FISTA, proximal TV", {"fista": {"iterations": 40}, **_proximal(16)}, (40,), True, part="better"),
    Run("fig7-exact-noise", "fig7-exact", "FISTA, weights of the noise, proximal TV", {"fista": {"iterations": 40, "weights": "noise"}, **_proximal(16)}, (40,), True, part="better"),
    Run("fig11-default", "fig11", "FDK, 10 subsets, TV of the noise found", {"fdk": {}, **_sart(30, 10), "tv": {}}, ("fdk", 10, 30), True, part="better"),
    Run("fig11-ten-steps", "fig11", "SART view by view, ten steps of TV", {**_sart(200), "tv": PAPER_TV}, FIG11, part="better"),
    Run("fig11-fista", "fig11", "FISTA, proximal TV", {"fista": {"iterations": 50}, **_proximal(16)}, (50,), part="better"),
    *(
        run
        for scan in ("arm", "arm-binned")
        for run in (
            Run(f"{scan}-default", scan, "FDK, 10 subsets, TV of the noise found", {"fdk": {}, **_sart(30, 10), "tv": {}}, ("fdk", 10, 30), True, part="better"),
            Run(f"{scan}-momentum", scan, "FDK, 10 subsets, momentum, TV of the noise found", {"fdk": {}, **_sart(8, 10, momentum=True), "tv": {}}, (4, 8), True, part="better"),
            Run(f"{scan}-strong", scan, "FDK, 10 subsets, momentum, strong TV", {"fdk": {}, **_sart(8, 10, momentum=True), "tv": {"strength": "strong"}}, (8,), True, part="better"),
            Run(f"{scan}-fista", scan, "FISTA, TV of the noise found", {"fdk": {}, "fista": {"iterations": 20}, "tv": {}}, (20,), True, part="better"),
        )
    ),
    Run("arm-blocks", "arm", "2 x 2 pixels as one, momentum, steps of TV", {"binning": 2, "fdk": {}, **_sart(20, 10, momentum=True), "tv": {"alpha": 1 / 0.7, "after": "sart"}}, (20,), True, part="better"),
    Run("arm-blocks-light", "arm", "2 x 2 pixels as one, momentum, light TV of the noise found", {"binning": 2, "fdk": {}, **_sart(20, 10, momentum=True), "tv": {"strength": "light"}}, (20,), True, part="better"),
    # ---- iterations that end by themselves ----
    Run("fig5-auto", "fig5", "FDK, 10 subsets", {**RAM_LAK, **_auto(subsets=10)}, (), True, part="stop", twin="ten"),
    Run("fig7-auto", "fig7", "13 subsets", _auto(subsets=13), (), True, part="stop", twin="fig7-ordered"),
    Run("fig11-auto", "fig11", "FDK, 10 subsets, TV of the noise found", {"fdk": {}, **_auto(subsets=10), "tv": {}}, (), True, part="stop", twin="fig11-default"),
    Run("arm-auto", "arm", "FDK, 10 subsets, TV of the noise found", {"fdk": {}, **_auto(subsets=10), "tv": {}}, (), True, part="stop", twin="arm-default"),
]


@dataclass
class Posted:
    """A scan that the daemon has, and what it shows."""

    id: str
    truth: np.ndarray
    spacing: tuple
    body: object = None  # where errors are counted; None: everywhere
    facts: dict = field(default_factory=dict)


def _geometry(scan, data):
    """([view][4][3] for paper-project, what the daemon is told, rows, columns)"""
    if scan.kind == "arm":
        matrices = np.load(os.path.join(data, "carm_kct_248.npy"))
        # Of a detector of 616 x 480; column c of pixels of 2 x 2 is its column 2 c + .5.
        n = 616 // scan.pixels
        matrices = np.array([[1 / n, 0, (1 / n - 1) / 2], [0, 1 / n, (1 / n - 1) / 2], [0, 0, 1]]) @ matrices
        return objects.of_matrices(matrices), cbctd.Geometry.matrices(matrices, (scan.pixel_mm,) * 2), 480 // n, scan.pixels
    views = objects.circle(scan.views, scan.pixels, scan.pixels, scan.pixel_mm)
    told = cbctd.Geometry.circular(
        objects.SOURCE_TO_ISOCENTRE,
        objects.SOURCE_TO_DETECTOR,
        (scan.pixel_mm,) * 2,
        angles_deg=360 * np.arange(scan.views) / scan.views,
    )
    return views, told, scan.pixels, scan.pixels


def _object(scan, data):
    """(truth, spacing, body), None where the data are not here."""
    if scan.kind in ("voxels", "exact"):
        spacing = (CUBE / scan.side,) * 3
        return objects.head_voxels(scan.side, 8 if scan.kind == "exact" else 2), spacing, None
    if scan.kind == "anatomy":
        truth = objects.anatomy_voxels(data, (256, 256, SLAB), 0.5, (60.5, 50, 44))
        if truth is None:
            return None
        truth[[0, -1]] = 0  # the object ends within the grid
        return truth, (CUBE / 256,) * 3, None
    truth = objects.anatomy_voxels(data, (122, 101, 112), 1, (60.5, 50, 55.5))
    if truth is None:
        return None
    body = np.zeros(truth.shape, bool)
    body[16:96] = truth[16:96] > WATER * 0.5
    return truth, (1.5,) * 3, body


def post(client, name, options):
    """The scan's projections are made and sent; None where its data are not here."""
    scan = SCANS[name]
    made = _object(scan, options.data)
    if made is None:
        return None
    truth, spacing, body = made
    views, told, rows, columns = _geometry(scan, options.data)
    began = time.monotonic()
    if scan.kind == "exact":
        projections = objects.project_head(views, columns, rows)
    else:
        projections = objects.project_voxels(options.project, truth, spacing, views, columns, rows)
    if scan.kind == "arm":
        projections = objects.photon_noise(projections, 20000)
    elif scan.noise:
        projections = objects.multiplicative_noise(projections)
    seconds = time.monotonic() - began
    document = client.create_scan(told, projections.shape, name=name)
    client.upload(document["id"], projections)
    facts = {
        "object": scan.kind,
        "views": len(views),
        "columns": columns,
        "rows": rows,
        "pixel_mm": scan.pixel_mm,
        "voxels": list(truth.shape[::-1]),
        "spacing_mm": spacing[0],
        "noise": scan.noise,
        "maximum": float(truth.max()),
        "simulated_s": round(seconds, 2),
    }
    print(f"{name}: {projections.shape} projections, {seconds:.1f} s to make", flush=True)
    return Posted(document["id"], truth, spacing, body, facts)


# ---- one row ----


def _window(scan):
    """Gray scale of a picture in 1/mm: of the head up to .45 of its skull, of anatomy -250 to 450 HU, with Fig 11's noise
    -1000 to 1500 HU."""
    if scan.kind in ("voxels", "exact"):
        return 0.0, 0.45 * WATER
    return (0.0, 2.5 * WATER) if scan.kind == "anatomy" and scan.noise else (0.75 * WATER, 1.45 * WATER)


SLICES = {"fig5": 25, "fig5-exact": 25, "fig7": 23, "fig7-exact": 23, "table1": 16, "fig8": 100, "fig9": 16, "fig11": 16, "arm": 57, "arm-binned": 57}
# Value in 1/mm, red, green, blue, opacity per mm: soft tissue red and thin, bone ivory and dense.
TRANSFER = (
    (0.0, 0, 0, 0, 0),
    (0.85 * WATER, 0.7, 0.35, 0.28, 0),
    (0.95 * WATER, 0.95, 0.55, 0.45, 0.012),
    (1.1 * WATER, 0.95, 0.6, 0.5, 0.02),
    (1.16 * WATER, 1.0, 0.9, 0.75, 0.25),
    (1.3 * WATER, 1.0, 0.95, 0.85, 2.0),
    (2.0 * WATER, 1.0, 1.0, 1.0, 4.0),
)


def _iteration(name, last):
    return 0 if name == "fdk" else last if name == "final" else int(name.split("-")[1])


def _recipe(run, posted):
    recipe = {key: dict(value) if isinstance(value, dict) else value for key, value in run.recipe.items()}
    if recipe.get("tv", {}).get("unit") == "maximum/64":
        recipe["tv"]["unit"] = posted.facts["maximum"] / 64
    stage = next(recipe[name] for name in ("sart", "cgls", "fista") if name in recipe)
    last = stage.get("max_iterations", stage["iterations"])
    wanted = {n for n in run.shown if n != last}
    if run.curve:
        wanted |= set(range(1, last)) | ({"fdk"} if "fdk" in recipe else set())
    recipe["emit"] = sorted(wanted, key=lambda n: -1 if n == "fdk" else n)
    size = posted.truth.shape[::-1]
    recipe["grid"] = {"size": list(size), "spacing_mm": list(posted.spacing)}
    return recipe


def _errors(volume, posted, ssim):
    if posted.body is None:
        return objects.errors(volume, posted.truth, ssim)
    row = objects.errors(volume[posted.body], posted.truth[posted.body], False)
    if ssim:
        row["ssim"] = objects.ssim(volume[16:96], posted.truth[16:96])
    return row


def measure(client, run, posted, device):
    """Runs a job and compares what it keeps: (document, pictures)."""
    recipe, job = _recipe(run, posted), None
    busy = os.getloadavg()[0] > len(os.sched_getaffinity(0)) + 1  # with other programs: seconds say nothing then
    for _ in range(run.times):
        other = client.wait(client.submit(posted.id, recipe)["id"])
        if job is None or sum(r["seconds"] for r in other["history"]) < sum(r["seconds"] for r in job["history"]):
            job = other
    history = job["history"]
    low, high = _window(SCANS[run.scan])
    at = SLICES[run.scan]
    pictures = {"truth": objects.gray(posted.truth[at], low, high)}
    if run.name == "fig9":
        pictures["rendered-truth"] = objects.render(posted.truth, posted.spacing, TRANSFER)
    rows = []
    for volume in client.volumes(job["id"]):
        n = _iteration(volume.name, len(history))
        shown = (n if n else "fdk") in run.shown
        row = {"volume": volume.name, "iteration": n, **_errors(volume.voxels, posted, shown)}
        row["residual"] = history[n - 1]["residual"] if n else None
        row["seconds"] = job["timings"].get("fdk", 0) + sum(r["seconds"] for r in history[:n])
        rows.append(row)
        if shown:
            pictures[f"{n}"] = objects.gray(volume.voxels[at], low, high)
            if run.name == "fig9":
                pictures[f"rendered-{n}"] = objects.render(volume.voxels, posted.spacing, TRANSFER)
    rows.sort(key=lambda row: row["iteration"])
    document = {
        "name": run.name,
        "part": run.part,
        "title": run.title,
        "device": device,
        "device_name": job["device"],
        "backend": job["backend"],
        "busy": busy,
        "scan": run.scan,
        "facts": posted.facts,
        "recipe": {key: job.get(key) for key in ("fdk", "sart", "cgls", "fista", "tv", "projector", "precision")},
        "twin": run.twin,
        "stopped": job.get("stopped"),
        "shown": list(run.shown),
        "slice": at,
        "window_per_mm": [low, high],
        "timings": job["timings"],
        "warnings": [warning["code"] for warning in job["warnings"]],
        "history": history,
        "rows": rows,
    }
    client.delete_job(job["id"])
    last = rows[-1]
    print(
        f"  {run.name} on {device}: {run.title}, error {last['relative']:.4f} after {last['iteration']}, {last['seconds']:.3f} s",
        flush=True,
    )
    return document, pictures


# ---- the daemon ----


class Daemon:
    """A cbctd of its own on a free port, ended with the block."""

    def __init__(self, build, backend, threads):
        self.folder = tempfile.TemporaryDirectory(dir=os.environ.get("SCRATCH"))
        command = [os.path.join(build, "cbctd"), "--listen", "127.0.0.1:0", "--state-dir", os.path.join(self.folder.name, "state")]
        self.log = open(os.path.join(self.folder.name, "log"), "wb+")  # noqa: SIM115  it is closed with the daemon
        self.process = subprocess.Popen(
            [*command, "--backend", backend, "--threads", str(threads)], stdout=subprocess.PIPE, stderr=self.log, text=True
        )

    def __enter__(self):
        for line in self.process.stdout:
            found = re.match(r"listening on (http:\S+)", line)
            if found:
                self.client = cbctd.Client(found.group(1))
                for _ in range(600):
                    if self.client.ready():
                        return self.client
                    time.sleep(0.1)
                break
        self.__exit__()
        raise SystemExit("cbctd did not start")

    def __exit__(self, *_):
        self.process.terminate()
        self.process.wait()
        self.process.stdout.close()
        self.log.close()
        self.folder.cleanup()


def _devices(options):
    """(name, backend, threads) of the daemons to be measured; cpu-N is the processor with N threads."""
    with Daemon(options.build, options.backend, 0) as client:
        backend = client.devices()[0]["backend"]
    threads = len(os.sched_getaffinity(0))
    rows = [(f"cpu-{n}", "cpu", n) for n in dict.fromkeys((threads, 1))]
    return ([("cuda", "cuda", 0)] if backend == "cuda" else []) + rows


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--build", default=os.path.join(TOP, "build"), help="where cbctd and paper-project are")
    parser.add_argument("--project", help="paper-project, if it is elsewhere")
    parser.add_argument("--data", default=os.path.join(TOP, "..", "shared", "data"), help="the folder of test data")
    parser.add_argument("--results", required=True, help="a folder for JSON and pictures")
    parser.add_argument("--size", choices=("auto", "small", "all"), default="auto", help="small: up to 64^3 voxels; auto: all with a GPU")
    parser.add_argument("--backend", choices=("auto", "cpu"), default="auto")
    parser.add_argument("--only", default="", help="regular expression of names of runs")
    options = parser.parse_args()
    options.project = options.project or os.path.join(options.build, "paper-project")
    os.makedirs(options.results, exist_ok=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the daemon is ended, too
    began = time.monotonic()
    devices = _devices(options)
    small = options.size == "small" or (options.size == "auto" and devices[0][0] != "cuda")
    for i, (device, backend, threads) in enumerate(devices):
        runs = [run for run in RUNS if re.search(options.only, run.name) and (i == 0 or run.processors)]
        runs = [run for run in runs if SCANS[run.scan].small or not small]
        with Daemon(options.build, backend, threads) as client:
            for name in dict.fromkeys(run.scan for run in runs):
                posted = post(client, name, options)
                if posted is None:
                    print(f"SKIPPED: {', '.join(run.name for run in runs if run.scan == name)}: no CT volume in {options.data}")
                    continue
                for run in (run for run in runs if run.scan == name):
                    document, pictures = measure(client, run, posted, device)
                    path = os.path.join(options.results, f"{run.name}.{device}")
                    objects.write_json(path + ".json", document)
                    np.savez_compressed(path + ".npz", **pictures)
                client.delete_scan(posted.id)
    print(f"{time.monotonic() - began:.0f} s in all")


if __name__ == "__main__":
    main()
