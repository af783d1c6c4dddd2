#!/usr/bin/python3
"""What metal costs beside it: a table of designs, each of them a cbct of its own.

Usage: metal.py NAME=PATH/cbct ...

The scans are those of tests/http/metal.py: raw counts, 4e4 photons in air, through integrals of its own. For each case the
root mean square 3 to 10 mm from the metal and the mean error of bone there, in HU against FDK of the body alone, without
noise: of FDK, and after 3 iterations of SART. tests/bench/results/metal.txt keeps what it printed.
"""
import os
import subprocess
import sys
import tempfile

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), "..", "http"))
import metal  # pylint: disable=wrong-import-position

CASES = {"screws": 2500, "crossing": 2500, "parallel": 2500, "two screws": 2500, "rods": 2500, "wire": 1400, "vessel": 2000}


def recon(program: str, scan: str, out: str, threshold: int) -> None:
    grid = ["--grid", ",".join(map(str, metal.SIZE)), "--spacing", str(metal.SPACING)]
    how = ["--metal", str(threshold)] if threshold else []
    subprocess.run([program, "recon", scan, "-o", out, "--quiet", "--sart", "3", "--emit", "fdk", *grid, *how], check=True, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


def show(case: str, clean: str, out: str) -> str:
    row = []
    for name in "fdk", "final":
        figures = metal.beside(case, clean, os.path.join(out, name + ".nii"))
        bone = "     -" if figures["bone"] is None else f"{figures['bone']:6.0f}"
        row.append(f"{figures['rmse']:6.1f} {bone} {figures['mass']:5.2f}")
    return "   ".join(row)


def main(arguments: list) -> None:
    programs = dict(argument.split("=", 1) for argument in arguments)
    if not programs:
        sys.exit(__doc__)
    first = next(iter(programs.values()))
    with tempfile.TemporaryDirectory() as work:
        place = lambda name: os.path.join(work, name)  # noqa: E731
        metal.make("clean", place("clean"))
        recon(first, place("clean"), place("clean"), 0)
        print(f"{'HU':28s}  FDK: RMSE, bone, mass  SART: RMSE, bone, mass")
        for case, threshold in CASES.items():
            metal.make(case, place(case))
            for name, program, at in [("without", first, 0)] + [(n, p, threshold) for n, p in programs.items()]:
                recon(program, place(case), place(case), at)
                print(f"{case:11s} {name:16s}  {show(case, place('clean/fdk.nii'), place(case))}", flush=True)


main(sys.argv[1:])
