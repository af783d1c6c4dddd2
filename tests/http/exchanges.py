#!/usr/bin/python3
"""Holds every exchange that the black-box tests recorded (lib.sh) against the schema of its operation.

Usage: exchanges.py openapi.json FILE ...

A failure: a path, method, status, media type, header or query parameter that the schema does not have; a header that
comes twice; a JSON body or event that does not fit its schema or has a member that it does not name; a request that was
accepted though the schema forbids it; a warning that is told twice, or of a scan and of its job. Operations that no test
has exercised are reported.
"""
import collections
import itertools
import json
import re
import sys
import urllib.parse
from typing import Any, Dict, Iterator, List, Optional, Set, Tuple

import jsonschema

METHODS = ("get", "put", "post", "delete")
Schema = Dict[str, Any]


class Exchange:
    """One line of a record: method, target, status, header fields, what was sent as JSON, what came."""

    def __init__(self, line: str) -> None:
        self.method, self.target, status, headers, self.sent, self.body = line.rstrip("\n").split("\t", 5)
        self.status = int(status)
        fields = [(name.strip().lower(), value.strip()) for name, _, value in (field.partition(":") for field in headers.split("\x1f") if field)]
        self.headers = dict(fields)
        self.doubled = {name for name, count in collections.Counter(name for name, _ in fields).items() if count > 1}
        self.media_type = self.headers.get("content-type", "").partition(";")[0].strip()
        url = urllib.parse.urlsplit(self.target)
        self.path = url.path
        self.queries = [name for name, _ in urllib.parse.parse_qsl(url.query, keep_blank_values=True)]
        self.has_body = self.method != "HEAD" and self.status not in (204, 304)


class Document:
    """The schema and what is looked up in it."""

    def __init__(self, document: Schema) -> None:
        self.document = document
        self.resolver = jsonschema.RefResolver.from_schema(document)
        self.templates = [
            (re.compile(re.sub(r"\\{[a-z_]+\\}", "[^/]+", re.escape(path)) + "$"), path) for path in document["paths"]
        ]
        self.validators: Dict[int, jsonschema.Draft202012Validator] = {}

    def deref(self, value: Any) -> Any:
        while isinstance(value, dict) and "$ref" in value:
            value = self.resolver.resolve(value["$ref"])[1]
        return value

    def path(self, path: str) -> Optional[str]:
        for pattern, template in self.templates:
            if pattern.match(path):
                return template
        return None

    def operation(self, template: str, method: str) -> Optional[Schema]:
        return self.document["paths"][template].get("get" if method == "HEAD" else method.lower())

    def parameters(self, template: str, operation: Schema) -> Set[str]:
        listed = self.document["paths"][template].get("parameters", []) + operation.get("parameters", [])
        return {p["name"] for p in map(self.deref, listed) if p["in"] == "query"}

    def errors(self, schema: Schema, value: Any) -> Iterator[str]:
        """Where a value does not fit, and the members that nobody documented."""
        if id(schema) not in self.validators:
            self.validators[id(schema)] = jsonschema.Draft202012Validator(schema, resolver=self.resolver)
        for error in self.validators[id(schema)].iter_errors(value):
            best = jsonschema.exceptions.best_match([error])
            yield f"/{'/'.join(map(str, best.absolute_path))}: {best.message[:300]}"
        yield from self.unknown([schema], value, "")

    def branches(self, schemas: List[Any]) -> List[Schema]:
        """Each of them with what it refers to and is put together from."""
        found: List[Schema] = []
        for schema in map(self.deref, schemas):
            if isinstance(schema, dict):
                found.append(schema)
                for word in ("allOf", "anyOf", "oneOf"):
                    found += self.branches(schema.get(word, []))
        return found

    def unknown(self, schemas: List[Any], value: Any, at: str) -> Iterator[str]:
        branches = self.branches(schemas)
        if isinstance(value, list):
            items = [branch["items"] for branch in branches if "items" in branch]
            for i, item in enumerate(value[:50]):
                yield from self.unknown(items, item, f"{at}/{i}")
        if not isinstance(value, dict):
            return
        known: Dict[str, List[Any]] = collections.defaultdict(list)
        for branch in branches:
            for name, schema in branch.get("properties", {}).items():
                known[name].append(schema)
        for name, member in value.items() if known else ():
            if name not in known:
                yield f"{at}/{name}: a member that the schema does not name"
            else:
                yield from self.unknown(known[name], member, f"{at}/{name}")


def events(text: str) -> Iterator[Dict[str, str]]:
    """Of text/event-stream, newlines being \\x1e; one that was cut off is left out."""
    for block in text.split("\x1e\x1e")[:-1]:
        fields = dict(line.split(": ", 1) for line in block.split("\x1e") if ": " in line)
        if "data" in fields:
            yield fields


class Judge:
    def __init__(self, document: Document) -> None:
        self.document = document
        self.exercised: Set[Tuple[str, str]] = set()
        self.seen: Set[Tuple[str, str, str]] = set()
        self.told: Dict[str, Set[str]] = {}  # codes of the warnings of each scan, as it was last seen

    def body(self, schema: Schema, exchange: Exchange, text: str) -> Iterator[str]:
        if text == "":
            return
        try:
            value = json.loads(text)
        except ValueError as error:
            yield f"no JSON: {error}"
            return
        yield from self.document.errors(schema, value)

    def problem(self, exchange: Exchange) -> Iterator[str]:
        schema = self.document.document["components"]["schemas"]["Problem"]
        if exchange.media_type != "application/problem+json":
            yield f"{exchange.media_type or 'no media type'}, expected application/problem+json"
        else:
            yield from self.body(schema, exchange, exchange.body)

    def request(self, template: str, operation: Schema, exchange: Exchange) -> Iterator[str]:
        """Of one that was accepted."""
        for name in exchange.queries:
            if name not in self.document.parameters(template, operation):
                yield f"?{name}= is not documented"
        content = self.document.deref(operation.get("requestBody", {})).get("content", {})
        if "application/json" in content:
            for error in self.body(content["application/json"]["schema"], exchange, exchange.sent):
                yield f"accepted, though in the request {error}"

    def reply(self, response: Schema, exchange: Exchange) -> Iterator[str]:
        content = response.get("content", {})
        for name, header in response.get("headers", {}).items():
            if self.document.deref(header).get("required") and name.lower() not in exchange.headers:
                yield f"no {name} header"
        for name in exchange.doubled - {"set-cookie"}:
            yield f"the header {name} comes twice"
        if not exchange.has_body:
            return
        if exchange.media_type not in content:
            if content or exchange.headers.get("content-length") != "0":
                if exchange.status != 206:
                    yield f"{exchange.media_type or 'no media type'}, documented: {', '.join(content) or 'no body'}"
            return
        schema = content[exchange.media_type].get("schema")
        if "json" in exchange.media_type and schema is not None:
            yield from self.body(schema, exchange, exchange.body)
        if exchange.media_type == "text/event-stream":
            for event in events(exchange.body):
                kinds = content[exchange.media_type]["x-events"]
                if event.get("event") not in kinds:
                    yield f"event {event.get('event')} is not documented"
                else:
                    for error in self.body(kinds[event["event"]], exchange, event["data"]):
                        yield f"event {event['event']} {error}"

    def once(self, exchange: Exchange) -> Iterator[str]:
        """A fact is told once: no warning twice in a document, and no code in a job's and in its scan's."""
        try:
            document = json.loads(exchange.body)
            warnings = [(warning["code"], warning["detail"]) for warning in document["warnings"]]
        except (ValueError, KeyError, TypeError):
            return
        for code, _ in sorted({warning for warning in warnings if warnings.count(warning) > 1}):
            yield f"the warning {code} is told twice"
        codes = {code for code, _ in warnings}
        if "scan" in document:
            for code in sorted(self.told.get(document["scan"], set()) & codes):
                yield f"the warning {code} is told of the scan and of its job"
        elif "id" in document:
            self.told[document["id"]] = codes

    def judge(self, exchange: Exchange) -> Iterator[str]:
        template = self.document.path(exchange.path)
        if template is None:
            if exchange.status == 404:
                yield from self.problem(exchange)
            else:
                yield "a path that the schema does not have"
            return
        operation = self.document.operation(template, exchange.method)
        if operation is None:
            if exchange.status not in (400, 405):
                yield "a method that the schema does not have"
            else:
                yield from self.problem(exchange)
            return
        method = "get" if exchange.method == "HEAD" else exchange.method.lower()
        status = str(exchange.status)
        responses = operation["responses"]
        if status not in responses and "default" not in responses:
            yield f"status {status} is not documented"
            return
        self.seen.add((template, method, status if status in responses else "default"))
        if exchange.status < 400:
            self.exercised.add((template, method))
            yield from self.request(template, operation, exchange)
            if status not in responses:
                yield f"status {status} is not documented"
                return
        yield from self.reply(self.document.deref(responses.get(status, responses.get("default"))), exchange)


def main() -> int:
    with open(sys.argv[1], encoding="utf-8") as file:
        document = Document(json.load(file))
    judge = Judge(document)
    wrong: Dict[str, Tuple[int, str]] = {}
    count = 0
    for name in sys.argv[2:]:
        with open(name, encoding="utf-8", errors="replace", newline="\n") as file:
            # Who waits for a job asks the same again and again.
            for line in dict.fromkeys(file):
                exchange = Exchange(line)
                count += 1
                for error in itertools.chain(judge.judge(exchange), judge.once(exchange)):
                    key = f"{exchange.method} {document.path(exchange.path) or exchange.path} {exchange.status}: {error}"
                    times, example = wrong.get(key, (0, f"{name.rpartition('/')[2]}: {exchange.target}"))
                    wrong[key] = (times + 1, example)
    operations = {
        (path, method) for path, item in document.document["paths"].items() for method in METHODS if method in item
    }
    for error, (times, example) in sorted(wrong.items()):
        print(f"  {error} ({times} times, first in {example[:160]})")
    for path, method in sorted(operations - judge.exercised):
        print(f"  never exercised: {method.upper()} {path}")
    print(
        f"  {count} different exchanges, {len(judge.exercised)} of {len(operations)} operations,"
        f" {len(judge.seen)} documented replies"
    )
    return 1 if wrong or count == 0 else 0


sys.exit(main())
