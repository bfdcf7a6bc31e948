"""The OpenAPI document describes every route and field, and is deterministic."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from accord.api.openapi import document


@pytest.fixture(scope="module")
def api_document() -> dict[str, Any]:
    return json.loads(document())


def operations(api_document: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    return [
        (f"{method} {path}", operation)
        for path, methods in api_document["paths"].items()
        for method, operation in methods.items()
    ]


def test_every_route_and_parameter_has_a_description(api_document: dict[str, Any]) -> None:
    for address, operation in operations(api_document):
        assert operation.get("summary"), address
        assert len(operation.get("description", "")) > 20, address
        assert operation.get("tags"), address
        for parameter in operation.get("parameters", []):
            assert parameter.get("description"), (address, parameter["name"])


def test_every_schema_and_field_has_a_description(api_document: dict[str, Any]) -> None:
    schemas = api_document["components"]["schemas"]
    assert len(schemas) > 20
    for name, schema in schemas.items():
        if name in {"HTTPValidationError", "ValidationError"}:
            continue  # FastAPI's own schemas
        assert schema.get("description"), name
        for field, described in schema.get("properties", {}).items():
            # A bare reference is described by its target.
            assert described.get("description") or set(described) == {"$ref"}, f"{name}.{field}"


def test_settings_of_a_new_experiment_have_ranges_and_defaults(api_document: dict[str, Any]) -> None:
    schema = api_document["components"]["schemas"]["NewExperiment"]
    assert schema["required"] == ["name", "task"]
    assert schema["additionalProperties"] is False
    policy = schema["properties"]["policy"]
    assert policy["additionalProperties"] is False
    assert policy["properties"]["hidden"]["type"] == "array"
    settings = schema["properties"] | policy["properties"]
    for field in set(settings) - {"name", "instructions", "task", "policy"}:
        described = settings[field]
        assert described["description"], field
        assert "default" in described, field
        if described["type"] in {"integer", "number"}:
            assert "minimum" in described or "exclusiveMinimum" in described, field
            assert "maximum" in described, field


def test_every_response_has_a_schema(api_document: dict[str, Any]) -> None:
    for address, operation in operations(api_document):
        for status, response in operation["responses"].items():
            if status in {"204", "303", "304", "416"}:
                continue
            assert response.get("content"), (address, status)


def test_operation_ids_are_unique_and_short(api_document: dict[str, Any]) -> None:
    names = [operation["operationId"] for _, operation in operations(api_document)]
    assert len(names) == len(set(names))
    assert all(name.isidentifier() and len(name) < 30 for name in names)


def test_only_health_and_ways_to_sign_in_need_no_sign_in(api_document: dict[str, Any]) -> None:
    assert api_document["security"]
    public = [address for address, operation in operations(api_document) if operation.get("security") == []]
    links = [f"{method} /api/v1/{path}/{{token}}" for method in ("get", "post") for path in ("join", "sign-in")]
    oidc = [f"get /api/v1/oidc{path}" for path in ("", "/start", "/callback", "/sign-out")]
    assert sorted(public) == sorted(["get /api/v1/health", "get /api/v1/ready", *links, *oidc])


def test_document_is_deterministic(tmp_path: Path) -> None:
    file = tmp_path / "openapi.json"
    subprocess.run([sys.executable, "-m", "accord.api.openapi", str(file)], check=True, cwd=tmp_path)
    assert file.read_text() == document()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["openapi.json"]
