import { useMemo } from "react";
import { pointsOf, versionMetric } from "@/shared/api/metrics";
import type { Experiment, MetricPoint, Metrics, RewardVersion } from "@/shared/api/types";
import { formatCompact, formatPercent, formatValue } from "@/shared/ui/format";
import { Chart } from "./Chart";
import type { Curve, Marker } from "./chartOptions";

interface CurvesProps {
  experiment: Experiment;
  metrics: Metrics | undefined;
  versions: readonly RewardVersion[];
  /** whether to show the true return, which the server never sends to labellers */
  showTrueReturn: boolean;
}

/** Charts of returns, labels and held-out accuracy. */
export function Curves({ experiment, metrics, versions, showTrueReturn }: CurvesProps) {
  const markers = useMemo<Marker[]>(
    () => versions.map(({ number, policy_steps }) => ({ x: policy_steps, name: `v${number}` })),
    [versions],
  );
  const total = Number(experiment.config.total_steps);
  const stepAxis = { markers, xLabel: "training steps", xMax: total, formatX: formatCompact };
  const trueReturn = pointsOf(metrics, "true_return") ?? [];
  const learned = pointsOf(metrics, "learned_return") ?? [];
  const labels = pointsOf(metrics, "labels") ?? [];
  const accuracy = useMemo(() => accuracyOf(versions), [versions]);
  return (
    <div className="curves">
      {showTrueReturn && (
        <Chart
          {...stepAxis}
          title="True return"
          curve={curveOf(trueReturn)}
          format={formatValue}
          colour="a"
        />
      )}
      <Chart {...stepAxis} title="Learned return" curve={curveOf(learned)} format={formatValue} colour="b" />
      <Chart
        {...stepAxis}
        title="Labels"
        curve={curveOf(labels)}
        format={formatCompact}
        colour="c"
        yMin={0}
        integers
      />
      <Chart
        title="Held-out accuracy"
        curve={accuracy}
        markers={[]}
        xLabel="reward version"
        xMax={Math.max(2, versions.length)}
        formatX={(value) => (Number.isInteger(value) ? String(value) : "")}
        format={formatPercent}
        colour="d"
        yMin={0}
        yMax={1}
        perVersion
      />
    </div>
  );
}

function curveOf(points: readonly MetricPoint[]): Curve {
  return { x: points.map(({ step }) => step), y: points.map(({ value }) => value) };
}

function accuracyOf(versions: readonly RewardVersion[]): Curve {
  const points = versions
    .map((version) => ({ x: version.number, y: versionMetric(version, "holdout_accuracy") }))
    .filter((point): point is { x: number; y: number } => point.y !== null)
    .sort((a, b) => a.x - b.x);
  return { x: points.map(({ x }) => x), y: points.map(({ y }) => y) };
}
