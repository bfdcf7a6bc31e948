"""A report as one page that needs nothing beside it, and as JSON."""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path

from mapt.studies.diagnosis import Diagnosis

#: lines of the page's table: metric, what it is, format
_LINES: tuple[tuple[str, str, str], ...] = (
    ("accuracy", "pairs whose better segment is told as the teacher labels it", ".2%"),
    ("loss", "cross-entropy, nats", ".4f"),
    ("ece", "expected calibration error", ".3f"),
    ("rank_correlation", "rank correlation of scores and true returns of segments", ".3f"),
    ("rank_correlation_late", "the same over the newest fifth", ".3f"),
    ("rank_correlation_teacher", "rank correlation of scores with what the teacher judges by", ".3f"),
    ("step_correlation", "correlation of r-hat and true reward of steps", ".3f"),
    ("step_correlation_within", "the same within segments, their means taken away", ".3f"),
    ("breadth", "middle half of the rewards in their range (small: most are alike)", ".3f"),
    ("true_breadth", "the same of the true reward", ".3f"),
    ("spread_across_agents", "deviation among the agents of a step, in deviations of all rewards", ".3f"),
    ("past_share", "variance of r-hat that is not the Markov path's, in r-hat's", ".3f"),
    ("weight_concentration", "concentration of the weights of steps (0: all weigh the same)", ".3f"),
    ("parameters", "parameters", ",.0f"),
)
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1b1f24; max-width: 1080px; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.15rem; margin-top: 2.4rem; }
p { max-width: 46rem; } .quiet { color: #59636e; }
table { border-collapse: collapse; } th, td { padding: .3rem 0; border-bottom: 1px solid #d8dee4; }
th { text-align: left; }
td + td, th + th { text-align: right; padding-left: 1.6rem; font-variant-numeric: tabular-nums; }
img { max-width: 100%; height: auto; }
@media (prefers-color-scheme: dark) {
  body { background: #14171a; color: #e6e9ec; } .quiet { color: #9aa4ae; } th, td { border-color: #31373d; }
  img { background: #fff; border-radius: 4px; }
}
"""


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure of the report, already written."""

    path: Path
    title: str
    #: how to read it
    text: str


def write_page(
    path: Path, title: str, facts: Sequence[str], diagnoses: Sequence[Diagnosis], pictures: Sequence[Picture]
) -> None:
    """Write the page; pictures are inside it."""
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{escape(title)}</title>",
        "<meta name=viewport content='width=device-width, initial-scale=1'>",
        f"<style>{_STYLE}</style><h1>{escape(title)}</h1>",
        f"<p class=quiet>{'<br>'.join(escape(fact) for fact in facts)}</p>",
        _table(diagnoses),
    ]
    for picture in pictures:
        encoded = base64.b64encode(picture.path.read_bytes()).decode()
        parts.append(
            f"<h2>{escape(picture.title)}</h2><p>{escape(picture.text)}</p>"
            f"<img alt='{escape(picture.title, quote=True)}' src='data:image/png;base64,{encoded}'>"
        )
    path.write_text("\n".join(parts) + "\n")


def write_numbers(path: Path, about: Mapping[str, object], diagnoses: Sequence[Diagnosis]) -> None:
    """Write every number as JSON."""
    document = {
        **about,
        "models": [
            {
                "name": diagnosis.name,
                "network": dict(diagnosis.network),
                "metrics": dict(diagnosis.metrics),
                "calibration": [asdict(each) for each in diagnosis.calibration],
                "agent_attention": None if diagnosis.agent_attention is None else diagnosis.agent_attention.tolist(),
            }
            for diagnosis in diagnoses
        ],
    }
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


def _table(diagnoses: Sequence[Diagnosis]) -> str:
    head = "".join(f"<th>{escape(diagnosis.name)}" for diagnosis in diagnoses)
    rows = [
        f"<tr><td>{escape(what)}" + "".join(f"<td>{_number(each.metrics.get(name), form)}" for each in diagnoses)
        for name, what, form in _LINES
    ]
    return f"<table><tr><th>{head}{''.join(rows)}</table>"


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)
