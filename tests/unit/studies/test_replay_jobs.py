"""Worker processes record the replays that are recorded here, whole or not at all."""

from mapt.processes import run_jobs
from mapt.studies.recording import Recording, record_replay
from mapt.studies.replay import Replay
from mapt.studies.replay_job import Progress, ReplayJob, make_replay

SHORT = Recording("HalfCheetah-2x3", policy_steps=8192, segment_steps=30, segments=12, seed=1)


def test_a_worker_records_what_is_recorded_here_and_tells_how_far_it_is(tmp_path):
    told: list[Progress] = []
    (done,) = run_jobs(make_replay, [ReplayJob(SHORT, tmp_path / "there")], 1, told=lambda job, news: told.append(news))
    assert done.failure is None
    assert [news.steps for news in told] == [4096, 8192]
    here = record_replay(SHORT, tmp_path / "here")
    assert Replay.open(tmp_path / "there").fingerprint() == here.fingerprint()


def test_of_a_recording_that_is_stopped_nothing_is_kept(tmp_path):
    told: list[Progress] = []
    (done,) = run_jobs(
        make_replay,
        [ReplayJob(Recording("HalfCheetah-2x3", 10**9, 30, 12, 1), tmp_path / "replay")],
        1,
        told=lambda job, news: told.append(news),
        stopped=lambda: bool(told),
    )
    assert "was stopped" in (done.failure or "")
    assert not (tmp_path / "replay").exists()
