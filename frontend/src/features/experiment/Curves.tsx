import { useMemo } from "react";
import { pointsOf } from "@/shared/api/metrics";
import type { Experiment, MetricPoint, Metrics, RewardVersion } from "@/shared/api/types";
import { formatCompact, formatPercent, formatValue } from "@/shared/ui/words";
import { Chart, type Curve, type Mark } from "./Chart";
import { metricOf } from "./metric";

interface CurvesProps {
  experiment: Experiment;
  metrics: Metrics | undefined;
  versions: readonly RewardVersion[];
  /** room for the true return, which the server leaves out for labellers */
  withTrueReturn: boolean;
}

/** Labels, accuracy and returns. */
export function Curves({ experiment, metrics, versions, withTrueReturn }: CurvesProps) {
  const marks = useMemo<Mark[]>(
    () => versions.map(({ number, policy_steps }) => ({ x: policy_steps, name: `v${number}` })),
    [versions],
  );
  const total = Number(experiment.config.total_steps);
  const overSteps = { marks, xLabel: "policy steps", xMax: total, formatX: formatCompact };
  const trueReturn = pointsOf(metrics, "true_return") ?? [];
  const learned = pointsOf(metrics, "learned_return") ?? [];
  const labels = pointsOf(metrics, "labels") ?? [];
  const accuracy = useMemo(() => accuracyOf(versions), [versions]);
  return (
    <div className="curves">
      {withTrueReturn && (
        <Chart {...overSteps} title="True return" curve={curveOf(trueReturn)} format={formatValue} tone="a" />
      )}
      <Chart {...overSteps} title="Learned return" curve={curveOf(learned)} format={formatValue} tone="b" />
      <Chart
        {...overSteps}
        title="Labels"
        curve={curveOf(labels)}
        format={formatCompact}
        tone="c"
        yMin={0}
        whole
      />
      <Chart
        title="Held-out accuracy"
        curve={accuracy}
        marks={[]}
        xLabel="reward version"
        xMax={Math.max(2, versions.length)}
        formatX={(value) => (Number.isInteger(value) ? String(value) : "")}
        format={formatPercent}
        tone="d"
        yMin={0.4}
        yMax={1}
        dots
      />
    </div>
  );
}

function curveOf(points: readonly MetricPoint[]): Curve {
  return { x: points.map(({ step }) => step), y: points.map(({ value }) => value) };
}

function accuracyOf(versions: readonly RewardVersion[]): Curve {
  const points = versions
    .map((version) => ({ x: version.number, y: metricOf(version, "holdout_accuracy") }))
    .filter((point): point is { x: number; y: number } => point.y !== null)
    .sort((a, b) => a.x - b.x);
  return { x: points.map(({ x }) => x), y: points.map(({ y }) => y) };
}
