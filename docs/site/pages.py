"""Pages of the site that are not in docs/: those at the top of the repository, and the REST API from its schema."""

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
#: pages of the site by their file
TOP = {
    "index.md": "README.md",
    "CHANGELOG.md": "CHANGELOG.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    "CITATION.cff": "CITATION.cff",
}
SCHEMA = ROOT / "frontend" / "openapi.json"
ICON = ROOT / "frontend" / "public" / "icon.svg"
PREFIX = "/api/v1"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Called by MkDocs with the files of docs/."""
    for page, source in TOP.items():
        text = (ROOT / source).read_text().replace("](docs/", "](")
        files.append(File.generated(config, page, content=text))
    files.append(File.generated(config, "rest.md", content=rest_page(json.loads(SCHEMA.read_text()))))
    files.append(File.generated(config, "images/icon.svg", abs_src_path=str(ICON)))
    return files


def rest_page(document: dict[str, Any]) -> str:
    """Every operation and schema of an OpenAPI document as Markdown."""
    operations: dict[str, list[str]] = defaultdict(list)
    for path, methods in document["paths"].items():
        for method, operation in methods.items():
            operations[operation["tags"][0]].append(_operation(method, path, operation))
    schemas = document["components"]["schemas"]
    return "\n\n".join(
        (
            f"# REST\n\nVersion {document['info']['version']}. {document['info']['description']}",
            f"Paths are below `{PREFIX}`. [Conventions](reference.md#rest): error codes, labels, and what a scripted "
            "teacher calls. A running service has the same description at `/api/docs`, and the schema at "
            "`/api/openapi.json`.",
            *(f"## {tag.capitalize()}\n\n" + "\n\n".join(found) for tag, found in operations.items()),
            "## Schemas",
            *(_schema(name, schemas[name]) for name in sorted(schemas)),
        )
    )


def _operation(method: str, path: str, operation: dict[str, Any]) -> str:
    parts = [f"### {operation['summary']}", f"`{method.upper()} {path.removeprefix(PREFIX)}`", operation["description"]]
    if found := operation.get("parameters"):
        rows = [(f"`{each['name']}`", _in(each), _type(each["schema"]), each.get("description", "")) for each in found]
        parts.append(_table(("parameter", "in", "type", ""), rows))
    if body := operation.get("requestBody"):
        parts.append("Body: " + _content(body["content"]))
    answers = ((status, answer) for status, answer in operation["responses"].items() if status != "default")
    for status, answer in answers:
        parts.append(f"Response {status}: " + (_content(answer.get("content", {})) or "empty"))
    return "\n\n".join(parts)


def _in(parameter: dict[str, Any]) -> str:
    return parameter["in"] + (", required" if parameter.get("required") and parameter["in"] != "path" else "")


def _content(content: dict[str, Any]) -> str:
    return ", or ".join(
        _type(each.get("schema", {})) if kind == "application/json" else f"`{kind}`" for kind, each in content.items()
    )


def _schema(name: str, schema: dict[str, Any]) -> str:
    parts = [f"### {name}", schema.get("description", "")]
    required = schema.get("required", ())
    rows = [
        (f"`{field}`", _type(each) + ("" if field in required else ", optional"), each.get("description", ""))
        for field, each in schema.get("properties", {}).items()
    ]
    return "\n\n".join((*parts, _table(("field", "type", ""), rows) if rows else _type(schema)))


def _type(schema: dict[str, Any]) -> str:
    """The type of a value in a few words, with links to schemas."""
    if name := schema.get("$ref", "").rpartition("/")[2]:
        return f"[{name}](#{name.lower()})"
    if choices := schema.get("anyOf", schema.get("oneOf")):
        return " or ".join(_type(each) for each in choices)
    if "const" in schema or "enum" in schema:
        return ", ".join(f"`{json.dumps(each)}`" for each in schema.get("enum", [schema.get("const")]))
    kind = schema.get("type", "any")
    if kind == "array":
        return f"list of {_type(schema['items'])}"
    if kind == "object" and isinstance(values := schema.get("additionalProperties"), dict):
        return f"object of {_type(values)}"
    return kind


def _table(heading: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [heading, ("---",) * len(heading), *rows]
    return "\n".join(
        f"| {' | '.join(' '.join(cell.split()).replace('|', chr(92) + '|') for cell in line)} |" for line in lines
    )
