"""Uploads of exports: `accord import` from a browser."""

import shutil
import tempfile
import zipfile
from pathlib import Path
from typing import Annotated

from anyio.to_thread import run_sync
from fastapi import APIRouter, Query, Request
from starlette.requests import ClientDisconnect

from accord.api import responses, schemas
from accord.api.dependencies import Auth, AuthDep, IdempotencyKey
from accord.domain.enums import AuditAction
from accord.domain.errors import BodyTooLarge, Invalid
from accord.domain.permissions import may_run_experiments, require
from accord.services import audit, experiments, importing
from mapt.errors import PreferenceError
from mapt.preferences.formats.tables import PreferenceTables

router = APIRouter(tags=["experiments"])
PATH = "/experiments/import"
_TABLES = frozenset({"segments.parquet", "queries.parquet", "labels.parquet"})


@router.post(
    PATH,
    status_code=201,
    openapi_extra={"requestBody": {"required": True, "content": {"application/zip": {}}}},
    summary="Import an export",
)
async def import_experiment(
    name: Annotated[str, Query(max_length=200, description="Name of the new experiment.")],
    request: Request,
    auth: AuthDep,
    idempotency_key: IdempotencyKey = None,
) -> schemas.Experiment:
    """Creates a paused experiment with the settings, segments and labels of an export.

    Send the ZIP file that an export returns. If the import fails, nothing is left. For researchers and admins.
    """
    created = await run_sync(_check, auth, name, idempotency_key)
    if created is not None:
        return created
    with tempfile.TemporaryDirectory(prefix="accord-import-") as folder:
        archive = Path(folder) / "export.zip"
        try:
            with archive.open("wb") as file:
                async for chunk in request.stream():
                    await run_sync(file.write, chunk)
        except ClientDisconnect as error:
            raise Invalid("The upload was interrupted.") from error
        return await run_sync(_import, auth, archive, name, idempotency_key)


def _check(auth: Auth, name: str, key: str | None) -> schemas.Experiment | None:
    """Raises what can be known before the upload. Returns the experiment if an earlier request created it."""
    with auth.reading() as caller:
        require(may_run_experiments(caller.role), caller.role, "import experiments")
        row = experiments.created_by(caller.session, caller.user.id, key, name)
        if row is not None:
            return responses.experiment_response(caller.session, row, caller.role)
        experiments.require_unused_name(caller.session, name)
        return None


def _import(auth: Auth, archive: Path, name: str, key: str | None) -> schemas.Experiment:
    """Raises Invalid if the archive is not an export that can be imported."""
    folder = archive.with_suffix("")
    settings = auth.app.settings
    _extract(archive, folder, settings.max_import_bytes)
    try:
        tables = PreferenceTables.open(folder)
        with importing.storing(auth.app.blobs, tables) as found, auth.writing() as caller:
            require(may_run_experiments(caller.role), caller.role, "import experiments")
            importing.create(caller.session, caller.user.id, name, found, settings.max_training_bytes, key)
            row = experiments.get(caller.session, found.experiment_id)
            audit.record(caller.session, caller.user, AuditAction.EXPERIMENT_IMPORTED, row.id, name=row.name)
            return responses.experiment_response(caller.session, row, caller.role)
    except PreferenceError as error:
        # The person knows the name of the table, not this server's temporary folder.
        raise Invalid(str(error).replace(f"{folder}/", "")) from error


def _extract(archive: Path, folder: Path, limit_bytes: int) -> None:
    """Extracts the tables of an export, whatever folder of the archive they are in, and nothing else.

    Raises:
        Invalid: if it is not a ZIP file with the three tables.
        BodyTooLarge: if they are larger than an upload may be.
    """
    try:
        with zipfile.ZipFile(archive) as file:
            found = {Path(info.filename).name: info for info in file.infolist() if not info.is_dir()}
            missing = sorted(_TABLES - found.keys())
            if missing:
                raise Invalid(f"The file is not an export of Accord: it does not contain {missing[0]}.")
            if sum(found[name].file_size for name in _TABLES) > limit_bytes:
                raise BodyTooLarge(limit_bytes)
            folder.mkdir()
            for name in sorted(_TABLES):
                with file.open(found[name]) as packed, (folder / name).open("wb") as table:
                    shutil.copyfileobj(packed, table)
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError) as error:
        raise Invalid(f"The file is not a complete ZIP file: {error}. Export the experiment again.") from error
