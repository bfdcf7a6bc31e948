"""Downloads of whole experiments."""

import shutil
import tempfile
import zipfile
from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import FileResponse
from starlette.background import BackgroundTask

from accord.api.dependencies import AuthDep, ExperimentId
from accord.domain.enums import AuditAction
from accord.domain.permissions import may_run_experiments, require
from accord.services import audit, export

router = APIRouter(tags=["experiments"])
_MEDIA_TYPE = "application/zip"


@router.get(
    "/experiments/{experiment_id}/export",
    response_class=FileResponse,
    responses={200: {"content": {_MEDIA_TYPE: {}}, "description": "Parquet tables, zipped."}},
    summary="Export an experiment",
)
def export_experiment(experiment_id: ExperimentId, auth: AuthDep) -> FileResponse:
    """Its segments, queries and labels as Parquet tables, zipped; as `accord export`. For researchers and admins."""
    with auth.reading() as caller:
        require(may_run_experiments(caller.role), caller.role, "export experiments")
        found = export.contents(caller.session, experiment_id)
    with auth.writing() as caller:
        audit.record(caller.session, caller.user, AuditAction.EXPERIMENT_EXPORTED, experiment_id, what="tables")
    folder = Path(tempfile.mkdtemp(prefix="accord-export-"))
    try:
        export.write(auth.app.blobs, found, folder / experiment_id)
        archive = _zipped(folder / experiment_id)
    except BaseException:
        shutil.rmtree(folder)
        raise
    return FileResponse(
        archive,
        media_type=_MEDIA_TYPE,
        filename=archive.name,
        background=BackgroundTask(shutil.rmtree, folder),
    )


def _zipped(folder: Path) -> Path:
    """A ZIP file beside a folder, with the folder in it. It is not compressed, because Parquet is already."""
    archive = folder.with_suffix(".zip")
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as file:
        for path in sorted(folder.iterdir()):
            file.write(path, f"{folder.name}/{path.name}")
    return archive
