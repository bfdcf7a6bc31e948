"""`python -m accord.api.openapi FILE` writes the OpenAPI document from which the page's client is generated."""

import argparse
import json
from pathlib import Path
from tempfile import gettempdir

from accord.api.app import create_app
from accord.settings import Settings
from accord.store.blobs import open_blobs
from accord.store.database import Database
from mapt.io import atomic_write


def document() -> str:
    """The OpenAPI document as JSON, deterministic for the same routes."""
    app = create_app(Settings(), Database.open("sqlite://"), open_blobs(f"file://{gettempdir()}"))
    return json.dumps(app.openapi(), indent=2) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path, help="where to write it, for example frontend/openapi.json")
    atomic_write(parser.parse_args().file, document().encode())


if __name__ == "__main__":
    main()
