#!/usr/bin/python3
"""What gpu_bench has measured, beside goals, peers, the card's ceilings and the last kept result on the same kind of card.

Usage: gpu_rows.py MEASURED.json [--kept FOLDER] [--picture FILE.svg]

MEASURED.json is what gpu.sh writes. gpu_rows.json beside this file has the goals (any geometry, untilted; one for what has
no geometry) and the best peer's recorded time on an H200, in ms. Exits with 1 when a row is more than 10 % slower than in
the newest file of FOLDER (default: results beside this file) that was measured on a device of the same name.
"""
import argparse
import json
import pathlib
import sys
from typing import Any, Dict, Iterator, List, NamedTuple, Optional, Tuple

HERE = pathlib.Path(__file__).resolve().parent
SLOWER = 1.1  # times the kept result, that fail
NOISE = 0.02  # ms: launches of less differ by more than a tenth from visit to visit
KINDS = ("any", "untilted")

Key = Tuple[str, str, str]


class Row(NamedTuple):
    key: Key  # case, geometry, what
    ms: float
    ceiling: Optional[float]  # ms that the card's ceiling allows
    goal: Optional[float]
    peer: Optional[Tuple[str, float]]
    kept: Optional[float]


def times(measured: Dict[str, Any]) -> Dict[Key, Dict[str, Any]]:
    return {(r["case"], r["geometry"], r["what"]): r for r in measured["results"] if "ms" in r}


def last_kept(folder: pathlib.Path, device: str) -> Tuple[str, Dict[Key, Dict[str, Any]]]:
    """The newest result of a device, by the date in its name, and what it is called; nothing where there is none."""
    for path in sorted(folder.glob("*.json"), reverse=True):
        kept = json.loads(path.read_text())
        if kept.get("device") == device and "results" in kept:
            return path.stem, times(kept)
    return "none", {}


def rows(measured: Dict[str, Any], kept: Dict[Key, Dict[str, Any]]) -> Iterator[Row]:
    table = {(row["case"], row["what"]): row for row in json.loads((HERE / "gpu_rows.json").read_text())}
    for key, result in times(measured).items():
        case, kind, what = key
        known = table.get((case, what), {})
        goals: List[Optional[float]] = known.get("goal", [])
        at = KINDS.index(kind) if kind in KINDS else 0
        part = result.get("of_ceiling", 0)
        yield Row(
            key,
            result["ms"],
            result["ms"] * part if part > 0 else None,
            goals[at] if at < len(goals) else None,
            tuple(known["peer"]) if known.get("peer") else None,
            kept[key]["ms"] if key in kept else None,
        )


def is_behind(row: Row) -> bool:
    return row.kept is not None and row.ms > SLOWER * row.kept and row.ms > row.kept + NOISE


def line(row: Row) -> str:
    case, kind, what = row.key
    goal = f"{row.goal:9.4g} {row.ms / row.goal:5.2f}" if row.goal else " " * 15
    peer = f"{row.peer[0]:>10} {row.peer[1]:8.4g} {row.peer[1] / row.ms:6.1f} x" if row.peer else " " * 28
    ceiling = f"{100 * row.ceiling / row.ms:5.0f} %" if row.ceiling else " " * 7
    kept = f"{row.ms / row.kept:6.3f}{'  BEHIND' if is_behind(row) else ''}" if row.kept else ""
    return f"{case} {kind:9} {what:25} {row.ms:10.4g}  {goal}  {peer}  {ceiling}  {kept}".rstrip()


def draw(found: List[Row], title: str, path: str) -> None:
    """Time against goal, peer and ceiling, as multiples of the goal, for all rows that have one."""
    import matplotlib  # only the picture needs it

    matplotlib.use("svg")
    matplotlib.rcParams.update({"svg.hashsalt": "cbctd", "svg.fonttype": "none"})
    import matplotlib.pyplot as plt

    shown = [row for row in found if row.goal][::-1]
    figure, axes = plt.subplots(figsize=(9, 0.24 * len(shown) + 1.4), layout="constrained")
    at = range(len(shown))
    axes.barh(at, [row.ms / row.goal for row in shown], color="#4878a8", height=0.62, label="measured", log=True)
    for name, marker, colour, values in (
        ("goal", "|", "black", [1.0 for _ in shown]),
        ("best peer", "D", "#c0504d", [row.peer[1] / row.goal if row.peer else None for row in shown]),
        ("the card's ceiling", "<", "#59a14f", [row.ceiling / row.goal if row.ceiling else None for row in shown]),
    ):
        points = [(value, y) for value, y in zip(values, at) if value is not None]
        axes.scatter([x for x, _ in points], [y for _, y in points], marker=marker, color=colour, s=60 if marker == "|" else 22, label=name, zorder=3)
    axes.set_yticks(list(at), [f"{case} {kind if kind != '-' else ''} {what}" for case, kind, what in (row.key for row in shown)], fontsize=7)
    axes.set_xlabel("time, multiples of the goal (left is faster)")
    axes.set_title(title, fontsize=9)
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(axis="x", which="major", alpha=0.3)
    axes.margins(y=0.01)
    axes.legend(fontsize=7, loc="lower right")
    figure.savefig(path, metadata={"Date": None})


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("measured")
    parser.add_argument("--kept", default=str(HERE / "results"))
    parser.add_argument("--picture")
    options = parser.parse_args()
    measured = json.loads(pathlib.Path(options.measured).read_text())
    name, kept = last_kept(pathlib.Path(options.kept), measured["device"])
    found = list(rows(measured, kept))
    print(f"{measured['device']}, {measured.get('commit', '')}; ms, goal and multiple of it, best peer and how many times as long it takes,")
    print(f"part of the card's ceiling, multiple of the kept result ({name})")
    for row in found:
        print(line(row))
    if options.picture:
        draw(found, f"{measured['device']}, {measured.get('date', '')} ({measured.get('commit', '')})", options.picture)
    behind = [row for row in found if is_behind(row)]
    print(f"{len(found)} rows, {len(behind)} more than 10 % behind {name}")
    return 1 if behind else 0


if __name__ == "__main__":
    sys.exit(main())
