"""The schema of record against the program's own tables of parameters: type, range, choices, default, unit's list.

Usage: parameters.py PARAMETERS.json OPENAPI.json       (`cbct parameters --json`, `proto/openapi.py --json`)

Prints a line for each difference; exit status 1 where there is any.
"""
import json
import sys
from typing import Any, Dict, Iterator, List

# Members of the documents that are no parameters, or no scalars: their shapes are tested elsewhere.
OTHERS = {
    "job": {"/scan", "/preset", "/emit", "/labels", "/send", "/patient", "/where", "/resume", "/refine/reference"},
    "scan": {"/name", "/labels", "/patient", "/study", "/source", "/projections/air_region", "/projections/beam_hardening",
             "/projections/lag", "/projections/scatter"}
    | {f"/geometry/{name}" for name in ("kind", "angles_deg", "matrices", "views", "id", "notes")},
}
REQUESTS = {"job": "JobRequest", "scan": "ScanRequest"}
# Replies that repeat members of the request with schemas of their own.
REPLIES: Dict[str, List[str]] = {"job": ["JobBrief"], "scan": []}

Node = Dict[str, Any]


def parts(schemas: Node, node: Node) -> Iterator[Node]:
    """The node and all that it refers to or is made of; null stands for an absent member and says nothing."""
    if node.get("type") == "null":
        return
    yield node
    if "$ref" in node:
        yield from parts(schemas, schemas[node["$ref"].rsplit("/", 1)[1]])
    for inner in node.get("oneOf", []) + node.get("allOf", []):
        yield from parts(schemas, inner)


def properties(schemas: Node, node: Node) -> Node:
    return {name: inner for part in parts(schemas, node) for name, inner in part.get("properties", {}).items()}


def leaves(schemas: Node, node: Node, pointer: str, others: set) -> Iterator[str]:
    """Pointers of all members that have no members of their own."""
    for name, inner in properties(schemas, node).items():
        path = f"{pointer}/{name}"
        if path in others:
            continue
        below = list(leaves(schemas, inner, path, others))
        yield from below or [path]


def at(schemas: Node, node: Node, pointer: str) -> List[Node]:
    """The parts of the member; [] where the schema has none."""
    found = [node]
    for name in pointer.split("/")[1:]:
        inner = {}
        for part in found:
            inner.update(properties(schemas, part))
        if name not in inner:
            return []
        found = list(parts(schemas, inner[name]))
    return found


def required(schemas: Node, node: Node, pointer: str) -> bool:
    above, _, name = pointer.rpartition("/")
    holders = at(schemas, node, above) if above else list(parts(schemas, node))
    return any(name in part.get("required", []) for part in holders)


def value(found: List[Node], name: str) -> Any:
    values = [part[name] for part in found if name in part]
    return values[0] if values else None


def choices(found: List[Node]) -> List[str]:
    return [word for part in found for word in part.get("enum", []) if word is not None]


def types(found: List[Node]) -> set:
    named = [part["type"] for part in found if "type" in part]
    return {kind for one in named for kind in ([one] if isinstance(one, str) else one)} - {"null"}


def compare(row: Node, found: List[Node]) -> Iterator[str]:
    def differs(name: str, mine: Any, theirs: Any) -> Iterator[str]:
        if mine != theirs:
            yield f"{name} is {json.dumps(mine)} in the schema, {json.dumps(theirs)} in the table"

    kind = row["type"]
    if not value(found, "description"):
        yield "has no description in the schema"
    yield from differs("default", value(found, "default"), row["default"])
    if kind == "choice":
        yield from differs("enum", sorted(choices(found)), sorted(row["choices"]))
        return
    plain = {"number": "number", "numbers": "number", "integer": "integer", "integers": "integer", "boolean": "boolean"}
    if "count" in row:
        yield from differs("type", sorted(types(found)), ["array"])
        for bound in ("minItems", "maxItems"):
            yield from differs(bound, value(found, bound), row["count"])
        items = [part["items"] for part in found if "items" in part]
        found = items[:1]
    yield from differs("type", sorted(types(found)), [plain[kind]])
    if kind == "boolean":
        return
    yield from differs("const", value(found, "const"), row.get("word"))
    for bound in ("minimum", "maximum"):
        yield from differs(bound, value(found, bound), row[bound])
    for bound in ("exclusiveMinimum", "exclusiveMaximum"):
        yield from differs(bound, value(found, bound), None)


def check(document: str, rows: List[Node], schemas: Node) -> Iterator[str]:
    request = {"$ref": f"#/components/schemas/{REQUESTS[document]}"}
    others = OTHERS[document]
    known = {row["pointer"] for row in rows}
    for pointer in leaves(schemas, request, "", others):
        if pointer not in known:
            yield f"{pointer}: in the schema, not in the table"
    for row in rows:
        found = at(schemas, request, row["pointer"])
        if not found:
            yield f"{row['pointer']}: in the table, not in the schema"
            continue
        for difference in compare(row, found):
            yield f"{row['pointer']}: {difference}"
        if required(schemas, request, row["pointer"]) != row["required"]:
            yield f"{row['pointer']}: required in the schema or the table only"
        for reply in REPLIES[document]:
            shown = at(schemas, {"$ref": f"#/components/schemas/{reply}"}, row["pointer"])
            if not shown:
                yield f"{row['pointer']}: not in {reply}"
            elif row["type"] == "choice" and sorted(choices(shown)) != sorted(row["choices"]):
                yield f"{row['pointer']}: other choices in {reply}"


def main() -> None:
    with open(sys.argv[1], encoding="utf-8") as file:
        tables = json.load(file)
    with open(sys.argv[2], encoding="utf-8") as file:
        schemas = json.load(file)["components"]["schemas"]
    assert set(tables) == set(REQUESTS), "a document for each table"
    differences = [line for document, rows in tables.items() for line in check(document, rows, schemas)]
    for line in differences:
        print(line)
    print(f"{sum(map(len, tables.values()))} parameters, {len(differences)} differences")
    sys.exit(1 if differences else 0)


main()
