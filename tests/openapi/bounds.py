"""The schema's bounds of the members of requests that no table of parameters has, tried on a daemon: each bound is
accepted, what lies beyond it is refused at its pointer.

Usage: bounds.py URL OPENAPI.json

Tried are choices, lengths of texts, lengths of lists and ranges of numbers. A value counts as accepted where the reply
does not refuse it at its own pointer. Prints a line for each difference; exit status 1 where there is any.
"""
import json
import sys
import urllib.error
import urllib.request
from typing import Any, Iterator, List, Tuple

Document = dict
URL = sys.argv[1]
SCAN: Document = {
    "detector": {"columns": 8, "rows": 8, "pixel_mm": [1, 1]},
    "projections": {"count": 12, "sample": "float32", "quantity": "intensity", "air": 60000},
    "geometry": {"kind": "circular", "source_to_isocentre_mm": 500, "source_to_detector_mm": 900, "angle_step_deg": 30},
}
IMAGES: Document = {"kind": "images", "columns": 8, "rows": 8}
BODY: Document = {"kind": "body", "amplitude": 1.3, "multiple": 0.3}
CIRCLES: Document = {"kind": "circles", "balls": 12, "diameter_mm": 110, "distance_mm": 90, "ball_mm": 3.2}
HELIX: Document = {"kind": "helix", "balls": 20, "diameter_mm": 110, "pitch_mm": 90, "angle_step_deg": 20, "ball_mm": 3.2}

# PATH, SCHEMA, BASE, and the members that are tried.
TRIED = [
    ("/v1/scans", "ScanRequest", SCAN,
     ["/name", "/patient/position", "/patient/name", "/patient/id", "/patient/sex", "/study/uid", "/study/id",
      "/study/accession_number", "/study/description", "/study/referring_physician", "/projections/beam_hardening",
      "/projections/air_region", "/projections/lag", "/projections/scatter/kernels", "/projections/scatter/fraction",
      "/patient/world_to_patient"]),
    ("/v1/scans", "ScanRequest", {**SCAN, "projections": {**SCAN["projections"], "scatter": IMAGES}},
     ["/projections/scatter/kind", "/projections/scatter/columns", "/projections/scatter/rows",
      "/projections/scatter/every"]),
    ("/v1/scans", "ScanRequest", {**SCAN, "projections": {**SCAN["projections"], "scatter": BODY}},
     ["/projections/scatter/amplitude", "/projections/scatter/multiple"]),
    ("/v1/jobs", "JobRequest", {"scan": "SCAN"}, ["/preset"]),
    ("/v1/calibrations", "CalibrationRequest", {"scan": "SCAN", "phantom": CIRCLES},
     ["/arm", "/phantom/kind", "/phantom/circles", "/phantom/balls", "/phantom/diameter_mm", "/phantom/distance_mm",
      "/phantom/ball_mm", "/phantom/first_angle_deg", "/phantom/shift_deg"]),
    ("/v1/calibrations", "CalibrationRequest", {"scan": "SCAN", "phantom": HELIX},
     ["/phantom/pitch_mm", "/phantom/angle_step_deg", "/phantom/large_ball_mm"]),
]
# Lists whose entries are not all alike: of the right length, and good.
LISTS = {
    "/projections/beam_hardening": [0, 1] + [0] * 6,
    "/projections/air_region": [0, 0, 1, 1],
    "/projections/lag": [{"share": 0.01, "frames": 3}] * 4,
    "/projections/scatter/kernels": [{"amplitude": 0.1, "power": 1, "width_mm": 100}] * 4,
    "/patient/world_to_patient": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
}


def parts(schemas: Document, node: Document) -> Iterator[Document]:
    yield node
    if "$ref" in node:
        yield from parts(schemas, schemas[node["$ref"].rsplit("/", 1)[1]])
    for inner in node.get("oneOf", []) + node.get("allOf", []):
        yield from parts(schemas, inner)


def at(schemas: Document, node: Document, pointer: str) -> Document:
    """The member of a schema, with all that it refers to."""
    for name in pointer.split("/")[1:]:
        node = next(part["properties"][name] for part in parts(schemas, node) if name in part.get("properties", {}))
    return {key: value for part in parts(schemas, node) for key, value in part.items()}


def put(document: Document, pointer: str, value: Any) -> Document:
    document = json.loads(json.dumps(document))
    names = pointer.split("/")[1:]
    inner = document
    for name in names[:-1]:
        inner = inner.setdefault(name, {})
    inner[names[-1]] = value
    return document


def post(path: str, document: Document) -> Tuple[int, Document]:
    request = urllib.request.Request(URL + path, json.dumps(document).encode(), {"Content-Type": "application/json"})
    try:
        with urllib.request.urlopen(request) as reply:
            return reply.status, json.load(reply)
    except urllib.error.HTTPError as refused:
        return refused.code, json.load(refused)


def refused(path: str, base: Document, pointer: str, value: Any) -> bool:
    status, reply = post(path, put(base, pointer, value))
    return status in (400, 422) and (reply.get("pointer") or "").startswith(pointer)


def text(member: Document, length: int) -> str:
    if "0-9" in member.get("pattern", ""):
        return "1" * length
    if length > 64 and member["maxLength"] == 194:  # three groups of a person's name
        return "=".join(["x" * 64] * 3) + "x" * (length - 194)
    return "x" * length


def values(pointer: str, member: Document) -> Iterator[Tuple[str, Any, bool]]:
    """What is tried, in words and as a value, and whether it is to be refused."""
    if "enum" in member:
        for word in member["enum"]:
            if word is not None:
                yield f"choice {word!r}", word, False
        yield "another choice", "nonsense", True
    if "maxLength" in member:
        yield "the longest text", text(member, member["maxLength"]), False
        yield "a longer text", text(member, member["maxLength"] + 1), True
    if "maxItems" in member:
        yield "a list", LISTS[pointer], False
        yield "a longer list", LISTS[pointer] + [0] * (member["maxItems"] + 1 - len(LISTS[pointer])), True
        if member["minItems"] > 1:
            yield "a shorter list", LISTS[pointer][: member["minItems"] - 1], True
        else:
            yield "an empty list", [], True
    whole = member.get("type") in ("integer", ["integer", "null"])
    for bound, away in (("minimum", -1), ("maximum", 1)):
        if bound in member and "enum" not in member:
            yield f"the {bound}", member[bound], False
            yield f"beyond the {bound}", member[bound] + away * (1 if whole else 1e-3 * abs(member[bound]) or 1e-3), True


def check(schemas: Document, scan: str) -> Iterator[str]:
    for path, schema, base, pointers in TRIED:
        base = json.loads(json.dumps(base).replace('"SCAN"', json.dumps(scan)))
        for pointer in pointers:
            member = at(schemas, {"$ref": f"#/components/schemas/{schema}"}, pointer)
            tried = list(values(pointer, member))
            if not tried:
                yield f"{schema} {pointer}: no bound in the schema"
            for what, value, wanted in tried:
                if refused(path, base, pointer, value) != wanted:
                    yield f"{schema} {pointer}: {what} is {'accepted' if wanted else 'refused'}"


def main() -> None:
    with open(sys.argv[2], encoding="utf-8") as file:
        schemas = json.load(file)["components"]["schemas"]
    status, scan = post("/v1/scans", SCAN)
    assert status == 201, scan
    differences: List[str] = list(check(schemas, scan["id"]))
    for line in differences:
        print(line)
    sys.exit(1 if differences else 0)


main()
