import type { MetricPoint, Metrics } from "./types";

/** The curves with newer points merged in: a point of the same step replaces the old one, steps stay in order. */
export function mergeMetrics(old: Metrics | undefined, fresh: Metrics): Metrics {
  const series = new Map((old?.series ?? []).map((one) => [one.name, one.points]));
  for (const { name, points } of fresh.series) series.set(name, mergePoints(series.get(name) ?? [], points));
  return { series: [...series].map(([name, points]) => ({ name, points })) };
}

function mergePoints(old: MetricPoint[], fresh: MetricPoint[]): MetricPoint[] {
  const byStep = new Map(old.map((point) => [point.step, point]));
  for (const point of fresh) byStep.set(point.step, point);
  return [...byStep.values()].sort((a, b) => a.step - b.step);
}

export function pointsOf(metrics: Metrics | undefined, name: string): MetricPoint[] | null {
  return metrics?.series.find((one) => one.name === name)?.points ?? null;
}
