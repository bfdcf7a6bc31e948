"""Rows of metrics."""

from collections.abc import Sequence

from sqlalchemy import delete, func, insert, or_, select
from sqlalchemy.orm import Session, aliased

from accord.store.tables import MetricRow, utc_now


def replace(
    session: Session, experiment_id: str, step: int, values: dict[str, float], reward_version_id: str | None
) -> None:
    """Writes the points of one step. Existing points are deleted first, so that the new ones have higher ids."""
    session.execute(
        delete(MetricRow).where(
            MetricRow.experiment_id == experiment_id, MetricRow.step == step, MetricRow.name.in_(values)
        )
    )
    session.execute(
        insert(MetricRow),
        [
            {
                "experiment_id": experiment_id,
                "name": name,
                "step": step,
                "value": value,
                "reward_version_id": reward_version_id,
                "created_at": utc_now(),
            }
            for name, value in values.items()
        ],
    )


def points(
    session: Session, experiment_id: str, names: Sequence[str] | None, after_id: int, max_points: int | None = None
) -> list[MetricRow]:
    """Points written after an id, by name and step.

    Args:
        max_points: at least 2: of a curve with more, this many at equal distances, with the first and the last one.
    """
    statement = select(MetricRow).where(MetricRow.experiment_id == experiment_id, MetricRow.id > after_id)
    if names is not None:
        statement = statement.where(MetricRow.name.in_(names))
    if max_points is None:
        return list(session.scalars(statement.order_by(MetricRow.name, MetricRow.step)))
    numbered = statement.add_columns(
        func.row_number().over(partition_by=MetricRow.name, order_by=MetricRow.step).label("place"),
        func.count().over(partition_by=MetricRow.name).label("count"),
    ).subquery()
    place, count, intervals = numbered.c.place, numbered.c.count, max_points - 1
    # The last point of each interval, and the first point of all.
    chosen = or_(place == 1, place * intervals // count != (place - 1) * intervals // count)
    point = aliased(MetricRow, numbered)
    return list(session.scalars(select(point).where(chosen).order_by(point.name, point.step)))


def newest_id(session: Session, experiment_id: str) -> int:
    """The id of the point that was written last; 0 if there is none."""
    return session.scalar(select(func.max(MetricRow.id)).where(MetricRow.experiment_id == experiment_id)) or 0


def newest_values(session: Session, experiment_ids: Sequence[str], names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Experiment id -> name -> value at the latest step."""
    rows = session.execute(
        select(MetricRow.experiment_id, MetricRow.name, MetricRow.value)
        .where(MetricRow.experiment_id.in_(experiment_ids), MetricRow.name.in_(names))
        .order_by(MetricRow.step)
    )
    found: dict[str, dict[str, float]] = {}
    for experiment_id, name, value in rows:
        found.setdefault(experiment_id, {})[name] = value
    return found
