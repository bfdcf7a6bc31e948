"""Lines of a run: none missing, none twice."""

import pytest

from mapt.runs.errors import DamagedRun
from mapt.runs.metrics_file import MetricsFile, read_metrics


def test_lines_are_read_back_while_they_are_written(tmp_path):
    file = MetricsFile(tmp_path / "metrics.jsonl", 0)
    file.append({"iteration": 1, "reward_sha": "abc"})
    assert read_metrics(tmp_path / "metrics.jsonl") == [{"iteration": 1, "reward_sha": "abc"}]
    file.close()


def test_lines_after_the_checkpoint_are_made_again(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"iteration": 1}\n{"iteration": 2}\n{"iteration": 3}\n{"iter')
    file = MetricsFile(path, 2)
    assert [line["iteration"] for line in read_metrics(path)] == [1, 2]
    file.append({"iteration": 3.5})
    file.close()
    assert [line["iteration"] for line in read_metrics(path)] == [1, 2, 3.5]


@pytest.mark.parametrize("content", ["", '{"iteration": 1}\n', '{"iteration": 1}\n{"iteration": 2}'])
def test_fewer_lines_than_the_checkpoint_counts_are_refused(tmp_path, content):
    path = tmp_path / "metrics.jsonl"
    path.write_text(content)
    with pytest.raises(DamagedRun, match="2 lines"):
        MetricsFile(path, 2)
    assert path.read_text() == content


def test_a_line_in_the_making_is_not_read(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"iteration": 1}\n{"itera')
    assert read_metrics(path) == [{"iteration": 1}]


@pytest.mark.parametrize("content", ["no json\n", "[1]\n"])
def test_what_is_no_line_is_refused(tmp_path, content):
    (tmp_path / "metrics.jsonl").write_text(content)
    with pytest.raises(DamagedRun):
        read_metrics(tmp_path / "metrics.jsonl")
