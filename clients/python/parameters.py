"""Writes the table of parameters in cbctd.py from what `cbct parameters --json` prints, read from standard input.

Usage: cbct parameters --json | parameters.py [--check]

With --check nothing is written: exit status 1 where the table is another.
"""
import json
import sys
from pathlib import Path
from typing import Any, Dict, List

CLIENT = Path(__file__).with_name("cbctd.py")
BEGIN, END = "# The table of `cbct parameters`: parameters.py writes it.\n", "# The end of the table.\n"
KEPT = ("type", "minimum", "maximum", "count", "word", "choices")  # what a value is checked by


def checks(row: Dict[str, Any]) -> Dict[str, Any]:
    """The members that a value is held against; a list of whole numbers is refused with its unit."""
    kept = (*KEPT, "unit") if row["type"] == "integers" else KEPT
    return {key: row[key] for key in kept if key in row}


def table(documents: Dict[str, List[Dict[str, Any]]]) -> str:
    lines = ["_PARAMETERS: Dict[str, Dict[str, Document]] = {"]
    for name, rows in documents.items():
        lines.append(f'    "{name}": {{')
        for row in rows:
            lines.append(f'        "{row["pointer"]}": {json.dumps(checks(row))},')
        lines.append("    },")
    return "\n".join([*lines, "}\n"])


def main() -> int:
    text = CLIENT.read_text()
    head, rest = text.split(BEGIN)
    wanted = head + BEGIN + table(json.load(sys.stdin)) + END + rest.split(END)[1]
    if "--check" not in sys.argv:
        CLIENT.write_text(wanted)
    elif text != wanted:
        print(f"{CLIENT}: the table is not that of `cbct parameters --json`: `make python-parameters` writes it")
        return 1
    return 0


sys.exit(main())
