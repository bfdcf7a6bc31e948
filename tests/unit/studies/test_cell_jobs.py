"""Worker processes make cells as they are made here."""

import os
import signal
from dataclasses import replace
from functools import partial
from multiprocessing import active_children

import numpy as np

from mapt.processes import run_jobs
from mapt.studies.cell import run_cell
from mapt.studies.cell_folder import CellFolder
from mapt.studies.cell_job import CellJob, make_cell
from mapt.studies.plan import TablePlan, table_jobs
from unit.studies.tiny_replay import TASK

QUICK, SLOW = "MA-MLP:hidden_dim=8:train.markov_epochs=1", "MA-MLP:hidden_dim=8:train.markov_epochs=100000"


def jobs_of(replay, *models: str) -> list[CellJob]:
    plan = TablePlan(TASK, models, ("oracle",), (30,), (0,), "small", 50, "cpu", models[0])
    return table_jobs(plan, {0: replay})


def test_a_cell_of_a_worker_is_the_one_made_here(tmp_path, replay):
    (job,) = jobs_of(replay, QUICK)
    started: list[CellJob] = []
    (done,) = run_jobs(partial(make_cell, tmp_path / "cells"), [job], 1, started=started.append)
    assert (done.job, done.failure, started) == (job, None, [job])
    np.testing.assert_array_equal(
        CellFolder(tmp_path / "cells").read(job.settings).result.logits, run_cell(job.settings, replay).logits
    )


def test_a_failure_is_told_and_the_other_cells_are_made(tmp_path, replay):
    good, other = jobs_of(replay, QUICK, QUICK + ":train.seed=0")
    bad = CellJob(replace(good.settings, teacher="nobody"), good.replay)
    done = {
        each.job.settings.key: each.failure
        for each in run_jobs(partial(make_cell, tmp_path / "cells"), [bad, good, other], 1)
    }
    assert "no teacher is called 'nobody'" in done[bad.settings.key]
    assert done[good.settings.key] is None
    assert done[other.settings.key] is None


def test_a_killed_worker_fails_its_own_cell_alone(tmp_path, replay):
    slow, quick = jobs_of(replay, SLOW + ":train.markov_patience=100000", QUICK)

    def kill_the_slow(job: CellJob) -> None:
        if job is slow:
            (child,) = active_children()
            os.kill(child.pid, signal.SIGKILL)

    done = {
        each.job.settings.key: each.failure
        for each in run_jobs(partial(make_cell, tmp_path / "cells"), [slow, quick], 1, started=kill_the_slow)
    }
    assert "died" in done[slow.settings.key]
    assert done[quick.settings.key] is None


def test_leaving_early_ends_the_workers(tmp_path, replay):
    quick, slow = jobs_of(replay, QUICK, SLOW + ":train.markov_patience=100000")
    running = run_jobs(partial(make_cell, tmp_path / "cells"), [quick, slow], 2)
    assert next(running).job == quick
    assert active_children()
    running.close()
    assert not active_children()
