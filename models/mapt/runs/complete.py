"""A run from its first step to its video."""

from mapt.rendering.errors import RenderingError
from mapt.runs.evaluation import Evaluation
from mapt.runs.folder import RunFolder
from mapt.runs.settings import RunSettings
from mapt.runs.training import Run, Watch
from mapt.runs.video import record_video


def complete_run(
    settings: RunSettings,
    folder: RunFolder,
    checkpoint_seconds: float,
    watch: Watch,
    *,
    video: bool = True,
    physics_threads: int = 0,
) -> Evaluation | None:
    """Train, evaluate and film; whatever of it is done already is not done again.

    A video that cannot be made is told to `watch`, and missing.

    Returns:
        What the final policy did; None if `watch` stopped the training before its steps were done.

    Raises:
        RunBusy: if another process trains in this folder.
        See `Run` for what else.
    """
    with (
        folder.locked(),
        Run(settings, folder, checkpoint_seconds, watch, physics_threads=physics_threads) as run,
    ):
        if not run.train():
            return None
        evaluation = folder.read_evaluation(run.learner.steps)
        if evaluation is None:
            folder.video.unlink(missing_ok=True)
            evaluation = run.evaluate()
            folder.write_evaluation(run.learner.steps, evaluation)
        if video and not folder.video.exists():
            _film(run, settings, folder, watch)
        return evaluation


def _film(run: Run, settings: RunSettings, folder: RunFolder, watch: Watch) -> None:
    seed = settings.policy.seed
    try:
        record_video(run.learner.policy, settings.task, folder.video, agent_obsk=settings.agent_obsk, seed=seed)
    except RenderingError as error:
        watch.note(f"No video: {error}")
