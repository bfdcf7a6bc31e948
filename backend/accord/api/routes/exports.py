"""Downloads: experiments, their reward models and policies."""

import shutil
import tempfile
import zipfile
from pathlib import Path

from fastapi import APIRouter
from fastapi.responses import FileResponse, Response
from starlette.background import BackgroundTask

from accord.api.dependencies import Auth, AuthDep, ExperimentId, RewardVersionNumber
from accord.domain.enums import AuditAction
from accord.domain.errors import PolicyNotFound
from accord.domain.permissions import may_run_experiments, require
from accord.services import audit, checkpoints, credit, experiments, export
from accord.services.publish import card_key
from accord.store.tables import RewardVersionRow

router = APIRouter(tags=["experiments"])
_MEDIA_TYPE = "application/zip"
_SAFETENSORS = "application/octet-stream"


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


@router.get(
    "/experiments/{experiment_id}/reward-versions/{number}/weights",
    response_class=Response,
    responses={200: {"content": {_SAFETENSORS: {}}, "description": "reward.safetensors of a saved reward model."}},
    summary="Get the weights of a reward version",
)
def get_reward_weights(experiment_id: ExperimentId, number: RewardVersionNumber, auth: AuthDep) -> Response:
    """Store them as reward.safetensors beside the card as reward.json: `mapt.load_reward` reads that folder.

    For researchers and admins.
    """
    row = _reward_version(auth, experiment_id, number)
    with auth.writing() as caller:
        what = {"what": "reward version", "number": number}
        audit.record(caller.session, caller.user, AuditAction.EXPERIMENT_EXPORTED, experiment_id, **what)
    return Response(auth.app.blobs.read(row.blob_key), media_type=_SAFETENSORS)


@router.get(
    "/experiments/{experiment_id}/reward-versions/{number}/card",
    response_class=Response,
    responses={200: {"content": {"application/json": {}}, "description": "reward.json of a saved reward model."}},
    summary="Get the card of a reward version",
)
def get_reward_card(experiment_id: ExperimentId, number: RewardVersionNumber, auth: AuthDep) -> Response:
    """The network's configuration and metrics, without which its weights cannot be read. For researchers and admins."""
    row = _reward_version(auth, experiment_id, number)
    return Response(auth.app.blobs.read(card_key(row.blob_key)), media_type="application/json")


@router.get(
    "/experiments/{experiment_id}/policy",
    response_class=Response,
    responses={200: {"content": {_SAFETENSORS: {}}, "description": "A file that `mapt.load_policy` reads."}},
    summary="Get the policy",
)
def get_policy(experiment_id: ExperimentId, auth: AuthDep) -> Response:
    """The newest checkpoint of the policy, with which `mapt.load_policy` acts or trains on.

    For researchers and admins.
    """
    with auth.writing() as caller:
        require(may_run_experiments(caller.role), caller.role, "download policies")
        experiments.get(caller.session, experiment_id)
        row = checkpoints.newest(caller.session, experiment_id)
        if row is None:
            raise PolicyNotFound(experiment_id)
        key = row.blob_key
        audit.record(caller.session, caller.user, AuditAction.EXPERIMENT_EXPORTED, experiment_id, what="policy")
    return Response(checkpoints.read_policy(auth.app.blobs, key), media_type=_SAFETENSORS)


def _reward_version(auth: Auth, experiment_id: str, number: int) -> RewardVersionRow:
    """Raises Forbidden, RewardVersionNotFound."""
    with auth.reading() as caller:
        require(may_run_experiments(caller.role), caller.role, "download reward models")
        return credit.version_of(caller.session, experiment_id, number)


def _zipped(folder: Path) -> Path:
    """A ZIP file beside a folder, with the folder in it. It is not compressed, because Parquet is already."""
    archive = folder.with_suffix(".zip")
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as file:
        for path in sorted(folder.iterdir()):
            file.write(path, f"{folder.name}/{path.name}")
    return archive
