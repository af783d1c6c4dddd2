"""One report of the experiments that experiments.py has left in a folder: `report.py RESULTS OUT` writes OUT.html, which needs
no other file, and OUT.pdf. Of each experiment the GPU's results are shown where there are some, else the processor's
with most threads; Table 1 has all devices."""

import base64
import glob
import html
import io
import json
import os
import sys
import textwrap

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from matplotlib.backends.backend_pdf import PdfPages  # noqa: E402
from PIL import Image  # noqa: E402

HALF = 256 * 0.3725 / 2  # of the cube, mm
WATER = 0.0192  # 1/mm


class Results:
    """What a folder holds: documents and pictures by run and device."""

    def __init__(self, folder):
        self.documents = {}
        for path in sorted(glob.glob(os.path.join(folder, "*.json"))):
            with open(path, encoding="ascii") as file:
                document = json.load(file)
            document["pictures"] = np.load(path[: -len("json")] + "npz")
            self.documents.setdefault(document["name"], {})[document["device"]] = document

    def devices(self, run):
        """The run's documents, the fastest kind of device first."""

        def order(device):
            return (device != "cuda", -int(device.split("-")[1]) if "-" in device else 0)

        found = self.documents.get(run, {})
        return [found[device] for device in sorted(found, key=order)]

    def best(self, run):
        return next(iter(self.devices(run)), None)


def row_of(document, iteration):
    return next((row for row in document["rows"] if row["iteration"] == iteration), None) if document else None


def least(document):
    return min(document["rows"], key=lambda row: row["relative"]) if document else None


def seconds(value):
    return f"{value:.3g}" if value >= 0.001 else f"{value:.1e}"


def took(document, value):
    """Seconds; none of a run beside which other programs had the processor."""
    return "busy" if document.get("busy") else seconds(value)


def device_name(document):
    return document["device_name"] or document["device"]


# ---- the document: blocks that both writers know ----


class Report:
    def __init__(self):
        self.blocks = []

    def head(self, text):
        self.blocks.append(("head", text))

    def say(self, text):
        self.blocks.append(("say", " ".join(text.split())))

    def table(self, header, rows):
        self.blocks.append(("table", header, [[str(cell) for cell in row] for row in rows]))

    def figure(self, figure, caption):
        self.blocks.append(("figure", figure, " ".join(caption.split())))

    def write_html(self, path):
        parts = [STYLE]
        for kind, *what in self.blocks:
            if kind == "head":
                parts.append(f"<h2>{html.escape(what[0])}</h2>")
            elif kind == "say":
                parts.append(f"<p>{html.escape(what[0])}</p>")
            elif kind == "table":
                head = "".join(f"<th>{html.escape(cell)}</th>" for cell in what[0])
                rows = "\n".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in what[1])
                parts.append(f"<table><tr>{head}</tr>\n{rows}</table>")
            else:
                image = base64.b64encode(_png(what[0])).decode("ascii")
                caption = html.escape(what[1])
                parts.append(f'<figure><img alt="{caption}" src="data:image/png;base64,{image}"><figcaption>{caption}</figcaption></figure>')
        with open(path, "w", encoding="utf-8") as file:
            file.write("\n".join(parts) + "\n</html>\n")

    def write_pdf(self, path):
        with PdfPages(path, metadata={"Title": TITLE}) as pdf:
            pages = _Pages(pdf)
            pages.lines([TITLE, ""], size=14)
            for kind, *what in self.blocks:
                if kind == "head":
                    pages.lines(["", what[0]], size=11)
                elif kind == "say":
                    pages.lines([*textwrap.wrap(what[0], 118), ""])
                elif kind == "table":
                    pages.lines([*_columns(*what), ""], family="monospace")
                else:
                    pages.picture(np.asarray(Image.open(io.BytesIO(_png(what[0]))).convert("RGB")))
                    pages.lines([*textwrap.wrap(what[1], 118), ""])
            pages.end()


class _Pages:
    """Text and pictures from top to bottom over pages of A4; lengths in inches."""

    WIDTH, HEIGHT, MARGIN = 8.27, 11.69, 0.7

    def __init__(self, pdf):
        self.pdf, self.page, self.left = pdf, None, 0.0

    def end(self):
        if self.page is not None:
            self.pdf.savefig(self.page, dpi=140)
            plt.close(self.page)
        self.page = None

    def room(self, height):
        """Where something so high begins, as a share of the page's height."""
        if self.page is None or self.left < height:
            self.end()
            self.page, self.left = plt.figure(figsize=(self.WIDTH, self.HEIGHT)), self.HEIGHT - 2 * self.MARGIN
        at = (self.left + self.MARGIN) / self.HEIGHT
        self.left -= height
        return at

    def lines(self, lines, size=8.0, family="sans-serif"):
        if family == "monospace":
            size = min(7.0, 7.0 * 117 / max(map(len, lines)))
        for line in lines:
            at = self.room(1.4 * size / 72)
            self.page.text(self.MARGIN / self.WIDTH, at, line, size=size, family=family, va="top")

    def picture(self, image):
        width = min(self.WIDTH - 2 * self.MARGIN, image.shape[1] / 90)
        height = width * image.shape[0] / image.shape[1]
        top = self.room(height + 0.1)
        box = (self.MARGIN / self.WIDTH, top - height / self.HEIGHT, width / self.WIDTH, height / self.HEIGHT)
        axis = self.page.add_axes(box)
        axis.imshow(image, interpolation="lanczos", aspect="auto")
        axis.axis("off")


TITLE = "The study's experiments, made again"
STYLE = f"""<!DOCTYPE html>
<html lang="en"><meta charset="utf-8"><title>{TITLE}</title>
<style>body{{font:15px/1.45 sans-serif;max-width:1150px;margin:2em auto;padding:0 1em;color:#222}}
table{{border-collapse:collapse;margin:1em 0;font-size:13px}}th,td{{border-bottom:1px solid #ccc;padding:.15em .7em;text-align:right}}
th:first-child,td:first-child{{text-align:left}}figure{{margin:1em 0}}img{{max-width:100%}}figcaption{{color:#555;font-size:13px}}</style>
<h1>{TITLE}</h1>"""


def _png(figure):
    """Of 256 colours, which these pictures get along with."""
    raw, out = io.BytesIO(), io.BytesIO()
    figure.savefig(raw, dpi=90, bbox_inches="tight")
    Image.open(raw).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)
    return out.getvalue()


def _columns(header, rows):
    widths = [max(len(row[i]) for row in [header, *rows]) for i in range(len(header))]
    return ["  ".join(cell.ljust(w) if i == 0 else cell.rjust(w) for i, (cell, w) in enumerate(zip(row, widths))) for row in [header, *rows]]


# ---- figures and tables ----

ERRORS = ["volume", "||v - t|| / ||t||", "RMSE, HU", "PSNR, dB", "SSIM", "residual", "seconds", "device"]


def error_rows(document, prefix=""):
    rows = []
    for name in document["shown"]:
        row = row_of(document, 0 if name == "fdk" else name)
        if row is None:
            continue
        rows.append(
            [
                prefix + ("FDK" if name == "fdk" else f"after {name}"),
                f"{row['relative']:.4f}",
                f"{row['rmse_hu']:.1f}",
                f"{row['psnr_db']:.1f}",
                f"{row['ssim']:.4f}" if "ssim" in row else "",
                f"{row['residual']:.4f}" if row["residual"] is not None else "",
                seconds(row["seconds"]),
                device_name(document),
            ]
        )
    return rows


def _is_head(document):
    return document["facts"]["object"] in ("voxels", "exact")


def pictures(lines):
    """Rows of slices, the truth first, one gray scale for all. lines: (label, document, iterations, 0 for FDK)."""
    columns = 1 + max(len(line[2]) for line in lines)
    figure, axes = plt.subplots(len(lines), columns, figsize=(2.5 * columns, 2.75 * len(lines)), squeeze=False)
    for (label, document, iterations), across in zip(lines, axes):
        low, high = document["window_per_mm"]
        facts = document["facts"]
        half_x, half_y = (n * facts["spacing_mm"] / 2 for n in facts["voxels"][:2])
        head = _is_head(document)
        # Row 0 is the least y: below for the head, whose y goes up; above for a patient, whose y goes to the back.
        extent = (-half_x, half_x, -half_y, half_y) if head else (-half_x, half_x, half_y, -half_y)
        for axis, key in zip(across, ["truth", *map(str, iterations)]):
            image = low + document["pictures"][key] / 255 * (high - low)
            shown = axis.imshow(image, cmap="gray", vmin=low, vmax=high, extent=extent, origin="lower" if head else "upper", interpolation="nearest")
            axis.set_title("object" if key == "truth" else "FDK" if key == "0" else f"{label} {key}", fontsize=9)
            axis.set_xlabel("x, mm", fontsize=7)
            axis.set_ylabel("y, mm", fontsize=7)
            axis.tick_params(labelsize=6)
            if not head:
                for text, x, y in (("R", 0.03, 0.5), ("L", 0.97, 0.5), ("A", 0.5, 0.97), ("P", 0.5, 0.03)):
                    axis.text(x, y, text, transform=axis.transAxes, color="yellow", fontsize=7, ha="center", va="center")
        for axis in across[1 + len(iterations) :]:
            axis.axis("off")
        bar = figure.colorbar(shown, ax=list(across), fraction=0.012, pad=0.01)
        bar.set_label("1/mm", fontsize=7)
        bar.ax.tick_params(labelsize=6)
    return figure


def curve(axis, document, what, label, against="iteration"):
    """error: relative to the truth; else a member of the history."""
    if what == "error":
        rows = [row for row in document["rows"] if against != "iteration" or row["iteration"] > 0]
        x, y = [row[against] for row in rows], [row["relative"] for row in rows]
    else:
        x, y = [row["iteration"] for row in document["history"]], [row[what] for row in document["history"]]
    axis.plot(x, y, label=label, marker="." if len(x) < 70 else None, linewidth=1, markersize=4)


def axes_of(count):
    figure, axes = plt.subplots(1, count, figsize=(4.6 * count, 3.4), squeeze=False)
    for axis in axes[0]:
        axis.grid(alpha=0.3)
        axis.tick_params(labelsize=8)
    return figure, axes[0]


# ---- sections ----


def introduction(report, results):
    devices = sorted({device_name(d) for run in results.documents for d in results.devices(run)})
    report.say(
        f"""The design of cbctd comes from a study of SART with total variation (TV) on a mobile C-arm (2010, GTX 280): FDK as a
        start, ray-driven projection, voxel-driven backprojection, TV after each iteration. This report makes its experiments
        again through the daemon: a cbctd is started, the scans are posted over HTTP, jobs asked for, and the volumes that they
        keep are fetched and compared with the object. Devices: {"; ".join(devices)}. Seconds are those of FDK and of the iterations
        up to the volume, as the job's document tells them; uploads, the device's start and downloads are not among them."""
    )
    report.head("What the study left open, chosen here")
    report.say(
        """The head is Kak and Slaney's in high contrast (its skull 0.0192/mm, the others -.8, -.2, -.2 and .1 times that, added),
        filling a cube of 95.36 mm. Full circle; source to isocentre 620 mm, to the detector 1100 mm; the first view's source at +x,
        angles grow counter-clockwise seen from +z. Detectors: for Figs 5 to 7 1.2 times as wide as the shadow of the cube's side; for
        Table 1 pixels of 6.88 mm, for Fig 8 of 0.529 mm, for Figs 9 to 11 of 0.713 mm, which hold the shadow of the cube's
        diagonal. Slices are numbered from 0. SART updates after each view, relaxation 1, nonnegative but where it is said."""
    )
    report.say(
        """Projections are made by a program that shares nothing with the daemon: the voxel object is the trilinear
        interpolation of its voxels, which is a cubic along a ray within each cell, so that two Gauss points in each cell give the
        exact line integral. "Exact integrals" are those of the ellipsoids themselves; the truth is then the mean over each
        voxel. Noise is p (1 - 0.3 r), r even in 0..1, one for each value. The noise's mean takes 15 % off every value: errors with it
        cannot go to zero."""
    )
    report.say(
        """TV's gray level is 1/64 of the object's maximum. Errors count the whole grid: ||v - t|| / ||t||; RMSE in Hounsfield
        units (0.0192/mm is water); PSNR with the object's maximum as its peak; SSIM in 3D with Gaussian windows (sigma 1.5, 11 voxels
        wide, K1 .01, K2 .03, the object's range), the mean of all windows within the grid. The residual is ||p - A v|| / ||p||, each view's
        as it is met in that iteration."""
    )


def figure_5(report, results):
    document = results.best("fig5")
    if not document:
        return
    report.head("Fig 5: 64^3 from 100 x 169^2, FDK as start, SART, no TV")
    report.say("The study shows that SART comes much closer to the object than FDK. So it does here.")
    report.table(ERRORS, error_rows(document))
    report.figure(pictures([("SART", document, [0, 3, 20, 35, 50])]), "Slice 25 (x to the right, y up): object, FDK, after 3, 20, 35 and 50 iterations.")
    report.head("Fig 6: convergence")
    report.say("The study: fast for five iterations, slow after. (a) has the FDK start at iteration 0.")
    figure, axes = axes_of(3)
    start = row_of(document, 0)["relative"]
    curve(axes[0], document, "error", "SART")
    axes[0].plot([0], [start], "o", markersize=4, label="FDK")
    for axis, name, label in zip(axes[1:], ("change", "residual"), ("||v - v before|| / ||v before||", "||p - A v|| / ||p||")):
        curve(axis, document, name, "SART")
        axis.set_ylabel(label)
    axes[0].set_ylabel("||v - object|| / ||object||")
    for axis, letter in zip(axes, "abc"):
        axis.set_yscale("log")
        axis.set_xlabel("iteration")
        axis.set_title(f"({letter})", fontsize=10)
        axis.legend(fontsize=8)
    figure.tight_layout()
    report.figure(figure, "(a) difference to the object, (b) change of the volume, (c) residual, against the iteration; logarithmic.")
    at = {n: row_of(document, n)["relative"] for n in (1, 5, 10, 50)}
    report.say(
        f"""Five iterations take the error from {start:.3f} to {at[5]:.4f}, a factor {(start / at[5]) ** 0.2:.2f} each; the 45 behind
        them to {at[50]:.4f}, a factor {(at[5] / at[50]) ** (1 / 45):.3f} each."""
    )


def figure_7(report, results):
    plain, tv = results.best("fig7-plain"), results.best("fig7-tv")
    if not plain or not tv:
        return
    report.head("Fig 7: 64^3 from 26 x 85^2 with noise, with and without TV")
    report.say(
        """From zero; TV by ten explicit steps of 0.1 with alpha 0.1 after each iteration; without TV voxels may become negative.
        The study: details are seen only with TV."""
    )
    report.table(ERRORS, error_rows(plain, "no TV, ") + error_rows(tv, "TV, "))
    lines = [("no TV,", plain, [3, 20, 35, 50]), ("TV,", tv, [3, 20, 35, 50])]
    report.figure(pictures(lines), "Slice 23, without TV above and with TV below; one gray scale, x to the right, y up.")
    figure, axes = axes_of(2)
    for document, label in ((plain, "no TV"), (tv, "TV")):
        curve(axes[0], document, "error", label)
        curve(axes[1], document, "residual", label)
    for axis, label in zip(axes, ("||v - object|| / ||object||", "||p - A v|| / ||p||")):
        axis.set_xlabel("iteration")
        axis.set_ylabel(label)
        axis.legend(fontsize=8)
    figure.tight_layout()
    report.figure(figure, "Without TV the residual goes on falling while the error climbs: what is fitted is noise.")


def table_1(report, results):
    names = (("table1", "view by view"), ("table1-at-once", "all views at once"))
    if not results.best("table1"):
        return
    report.head("Table 1: 32^3 from 26 x 43^2, 20 iterations from zero")
    rows = []
    for run, label in names:
        for document in results.devices(run):
            times = [row["seconds"] * 1000 for row in document["history"]]
            blocks = [sum(times[i : i + 4]) for i in range(0, 20, 4)]
            rows.append([label, device_name(document), *(f"{t:.3g}" for t in blocks), f"{sum(times):.4g}"])
    rows.append(["the study", "CPU, one thread", *[""] * 5, "6130"])
    rows.append(["the study", "GTX 280", *[""] * 5, "25.55"])
    report.table(["SART", "device", "1-4", "5-8", "9-12", "13-16", "17-20", "20 iterations"], rows)
    report.say("Milliseconds by blocks of four iterations; the fastest of three jobs on each device.")


def large(report, results):
    document = results.best("fig8")
    if document:
        report.head("Fig 8: 256^3 from 100 x 559^2, SART from zero, no TV")
        report.say(f"The study: 13.8 s for 50 iterations. Here {seconds(row_of(document, 50)['seconds'])} s on {device_name(document)}.")
        report.table(ERRORS, error_rows(document))
        report.figure(pictures([("SART", document, [5, 10, 50])]), "Slice 100; x to the right, y up.")
    document = results.best("fig9")
    if document:
        report.head("Fig 9: anatomy, 256 x 256 x 33 from 100 x 339^2, SART from zero, no TV")
        report.say(
            """The study's mouse is not public. In its place stands a slab of a real CT of the abdomen and pelvis (TotalSegmentator's example
            CT, github.com/wasserth/TotalSegmentator, Apache-2.0, 3 mm), resampled to 1.5 mm and put onto voxels of 0.3725 mm. The
            first and the last of the 33 slices are air, so that the object ends within the grid. Orientation: R, L, A, P are the patient's right, left, front and back."""
        )
        report.say(f"The study: 11.6 s for 200 iterations. Here {seconds(row_of(document, 200)['seconds'])} s on {device_name(document)}.")
        report.table(ERRORS, error_rows(document))
        report.figure(pictures([("SART", document, [1, 5, 10, 20]), ("SART", document, [40, 100, 200])]), "Slice 16 of 33, -250 to 450 HU.")
        report.head("Fig 10: volume renderings")
        steps = ["truth", 1, 5, 10, 20, 40, 100, 200]
        figure, axes = plt.subplots(2, 4, figsize=(14, 3.9))
        for axis, step in zip(axes.flat, steps):
            axis.imshow(document["pictures"][f"rendered-{step}"])
            axis.set_title("object" if step == "truth" else f"SART {step}", fontsize=9)
            axis.set_xticks([])
            axis.set_yticks([])
            axis.text(0.02, 0.5, "R", transform=axis.transAxes, color="yellow", fontsize=8)
            axis.text(0.96, 0.5, "L", transform=axis.transAxes, color="yellow", fontsize=8)
        figure.tight_layout()
        report.figure(figure, "The same volumes by compositing along parallel rays, one transfer function for all, seen from the front and 45 degrees above.")
    plain, tv = results.best("fig11-plain"), results.best("fig11-tv")
    if plain and tv:
        report.head("Fig 11: the same with noise, with and without TV")
        took = seconds(row_of(tv, 200)["seconds"])
        report.say(f"One step of TV after each iteration. The study: 12.2 s for 200 with TV. Here {took} s on {device_name(tv)}.")
        report.table(ERRORS, error_rows(plain, "no TV, ") + error_rows(tv, "TV, "))
        lines = [("no TV,", plain, [5, 20, 100, 200]), ("TV,", tv, [5, 20, 100, 200])]
        report.figure(pictures(lines), "Slice 16, without TV above and with TV below, -1000 to 1500 HU.")


def _reached(document, error):
    row = next((row for row in document["rows"] if row["iteration"] > 0 and row["relative"] <= error), None)
    return f"{row['iteration']} / {seconds(row['seconds'])} s" if row else "-"


def faster(report, results):
    runs = [results.best(run) for run in results.documents]
    runs = [d for d in runs if d["part"] == "faster"]
    views, once = results.best("views"), results.best("at-once")
    if not views or not once:
        return
    report.head("Beyond: faster to the same error")
    report.say(
        """The data of Fig 5, all from FDK (ram-lak). Iterations and seconds until the error is that of plain SART, all views at once
        and view by view, after 50 and after 100 iterations; - : not within the iterations that were run."""
    )
    targets = [row_of(d, n)["relative"] for d in (once, views) for n in (50, 100)]
    header = ["method", "iterations", "last error", *(f"to {t:.4f}" for t in targets), "s / iteration"]
    rows = []
    for d in sorted(runs, key=lambda d: d["rows"][-1]["relative"]):
        last = d["rows"][-1]
        each = sum(row["seconds"] for row in d["history"]) / len(d["history"])
        rows.append([d["title"], last["iteration"], f"{last['relative']:.4f}", *(_reached(d, t) for t in targets), seconds(each)])
    report.table(header, rows)
    report.say(f"Targets: all at once after 50 and 100, view by view after 50 and 100 iterations. Device: {device_name(views)}.")
    figure, axes = axes_of(2)
    for d in runs:
        curve(axes[0], d, "error", d["title"])
        curve(axes[1], d, "error", d["title"], against="seconds")
    for axis, label in zip(axes, ("iteration", "seconds, FDK among them")):
        axis.set_yscale("log")
        axis.set_xlabel(label)
        axis.set_ylabel("||v - object|| / ||object||")
    axes[0].legend(fontsize=6)
    figure.tight_layout()
    report.figure(figure, "Error against iterations and against seconds.")


def better(report, results):
    names = ["fig7-plain", "fig7-tv", *(run for run in results.documents if results.best(run)["part"] == "better"), "fig11-plain", "fig11-tv"]
    rows = []
    for d in filter(None, map(results.best, names)):
        last, best = d["rows"][-1], least(d)
        cells = [f"{best['relative']:.4f} ({best['iteration']})", f"{last['relative']:.4f} ({last['iteration']})", f"{last['rmse_hu']:.1f}"]
        rows.append((d["scan"], [d["scan"], d["title"], *cells, f"{last['ssim']:.4f}" if "ssim" in last else "", took(d, last["seconds"]), device_name(d)]))
    if not rows:
        return
    report.head("Beyond: nearer to the object")
    report.say(
        """The noisy scans and those of exact integrals by other methods. "arm" is the whole abdomen (3 mm CT on voxels of 1.5 mm) through
        the 248 calibrated matrices of a real C-arm, 197.6 degrees, 616 x 480 pixels with 20,000 photons in each, "arm-binned" the same
        with 308 x 240 pixels of twice the side, 20,000 photons in each, too; their errors count the body in slices 16 to 95. In brackets the iteration. "Least" is over the volumes that were kept.
        "busy": other programs had the processor, and seconds say nothing."""
    )
    report.table(["scan", "method", "least error", "last error", "RMSE, HU", "SSIM", "seconds", "device"], [row for _, row in sorted(rows, key=lambda r: r[0])])
    shown = [(label, results.best(run)) for run, label in (("fig7-tv", "TV,"), ("fig7-proximal", "momentum, TV,"), ("fig7-fista", "FISTA,"))]
    lines = [(label, d, [d["shown"][-1]]) for label, d in shown if d]
    if lines:
        report.figure(pictures(lines), "Fig 7's slice 23: the study's method and two of the newer ones, each at its end.")
    document = results.best("fig11-default")
    if document:
        caption = "Fig 11's slice 16 by the daemon's own defaults: FDK, 10 subsets, TV of the noise found; -1000 to 1500 HU."
        report.figure(pictures([("SART + TV", document, [0, 10, 30])]), caption)
    document = results.best("arm-default")
    if document:
        report.figure(pictures([("SART + TV", document, [0, 10])]), "The abdomen through the C-arm's matrices, slice 57, -250 to 450 HU.")


def stopping(report, results):
    rows = []
    for run in results.documents:
        d = results.best(run)
        twin = results.best(d.get("twin", ""))
        if not twin:
            continue
        end, best = d["rows"][-1], min((row for row in twin["rows"] if row["iteration"] > 0), key=lambda row: row["relative"])
        off = f"{100 * (end['relative'] / best['relative'] - 1):.1f} %"
        rows.append([d["scan"], d["title"], end["iteration"], d["stopped"]["rule"], f"{end['relative']:.4f}", best["iteration"], f"{best['relative']:.4f}", off])
    if not rows:
        return
    report.head("Beyond: when to stop")
    report.say('"iterations": "auto", at most 30, beside the best iteration of the same method with a number of iterations. Fig 5 has no noise.')
    report.table(["scan", "method", "ends after", "by", "error", "best after", "its error", "above it"], rows)


def times(report, results):
    """Of what was run on more than one device."""
    rows, devices = [], sorted({device for found in results.documents.values() for device in found if device != "cpu-1"}, key=lambda d: (d != "cuda", len(d), d))
    for run, found in results.documents.items():
        if len(set(found) & set(devices)) > 1:
            each = [took(found[device], found[device]["rows"][-1]["seconds"]) if device in found else "" for device in devices]
            d = results.best(run)
            rows.append([f"{d['scan']}: {d['title']}", d["rows"][-1]["iteration"], *each])
    if rows:
        report.head("Seconds by device")
        report.say("FDK and all iterations of a job; cpu-N is the processor with N threads.")
        report.table(["run", "iterations", *devices], sorted(rows))


def goals(report, results):
    """What the project has set itself; figures of an independent implementation beside it."""
    report.head("Goals")
    rows = []

    def goal(label, limit, other, value, form="{:.4f}"):
        if value is not None:
            verdict = "" if limit is None else "reached" if value <= limit else "NOT reached"
            rows.append([label, "" if limit is None else f"<= {limit:g}", other, form.format(value), verdict])

    def error(run, iteration):
        document = results.best(run)
        row = row_of(document, iteration) if iteration != "least" else least(document)
        return row["relative"] if row else None

    def smallest(runs, member="relative"):
        found = [row[member] for d in map(results.best, runs) if d for row in d["rows"]]
        return min(found) if found else None

    def rmse(run, iteration):
        row = row_of(results.best(run), iteration)
        return row["rmse_hu"] if row else None

    def time(run, iteration):
        row = row_of(results.best(run), iteration)
        return row["seconds"] if row else None

    goal("Fig 5, FDK ram-lak", None, ".161", error("fig5", 0))
    goal("Fig 5, view by view, 3 iterations", 0.025, ".020", error("fig5", 3))
    goal("Fig 5, view by view, 50 iterations", 0.003, ".0022", error("fig5", 50))
    goal("Fig 5, all at once, 50 iterations", None, ".103", error("at-once", 50))
    goal("Fig 5, all at once with momentum, 50", 0.03, ".028", error("at-once-momentum", 50))
    goal("Fig 5, 10 subsets with momentum, 20", 0.01, ".0086", error("ten-momentum", 20))
    goal("Fig 7, view by view without TV, 50", None, ".69", error("fig7-plain", 50))
    goal("Fig 7, the same at its best", None, ".46", error("fig7-plain", "least"))
    goal("Fig 7, with the study's TV, 50", 0.35, ".347", error("fig7-tv", 50))
    of_fig7 = [run for run in results.documents if results.best(run)["scan"] == "fig7"]
    goal("Fig 7, best method", 0.30, ".3255", smallest(of_fig7))
    goal("exact integrals, Fig 5, FDK hann", None, ".121", error("exact-tv", 0))
    goal("exact integrals, Fig 5, SART + TV at its best", 0.075, ".0755", error("exact-tv", "least"))
    of_exact = [run for run in results.documents if results.best(run)["scan"] == "fig7-exact"]
    goal("exact integrals, Fig 7, best method", 0.26, ".2625", smallest(of_exact))
    for scan, label in (("arm", "abdomen, 616 x 480"), ("arm-binned", "abdomen, 308 x 240")):
        goal(f"{label}, FDK hann, HU", None, "51.0", rmse(f"{scan}-default", 0), "{:.1f}")
        goal(f"{label}, SART + TV, 10 iterations, HU", None, "36.8", rmse(f"{scan}-default", 10), "{:.1f}")
        of_arm = [run for run in results.documents if results.best(run)["scan"] == scan]
        goal(f"{label}, best method, HU", 30, "", smallest(of_arm, "rmse_hu"), "{:.1f}")
        goal(f"{label}, momentum, 4 iterations, HU", 36.8, "", rmse(f"{scan}-momentum", 4), "{:.1f}")
    of_table1 = [d for d in results.devices("table1") if d["device"] == "cuda"]
    for document in of_table1:
        took = 1000 * sum(row["seconds"] for row in document["history"])
        goal("Table 1, GPU, 20 iterations view by view, ms", 25.55, "25.55 (study)", took, "{:.2f}")
    goal("Fig 8, 50 iterations, s", 0.5, "13.8 (study)", time("fig8", 50), "{:.3f}")
    goal("Fig 9, 200 iterations, s", 0.5, "11.6 (study)", time("fig9", 200), "{:.3f}")
    goal("Fig 11, 200 iterations with TV, s", None, "12.2 (study)", time("fig11-tv", 200), "{:.3f}")
    report.table(["goal", "limit", "others", "here", ""], rows)


def main():
    folder, out = sys.argv[1:]
    results = Results(folder)
    report = Report()
    introduction(report, results)
    for section in (goals, figure_5, figure_7, table_1, large, faster, better, stopping, times):
        section(report, results)
    report.write_html(out + ".html")
    report.write_pdf(out + ".pdf")
    for end in (".html", ".pdf"):
        print(f"{out}{end}: {os.path.getsize(out + end) / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
