import type { Experiment, RewardVersion } from "@/shared/api/types";
import { formatCompact, formatCount, formatPercent, phaseWords } from "@/shared/ui/words";
import { metricOf } from "./metric";

interface OverviewProps {
  experiment: Experiment;
  versions: readonly RewardVersion[];
  live: boolean;
}

/** Where the experiment stands, in four figures. */
export function Overview({ experiment, versions, live }: OverviewProps) {
  const { labels, steps, config } = experiment;
  const newest = versions.find(({ number }) => number === experiment.reward_version);
  const accuracy = metricOf(newest, "holdout_accuracy");
  return (
    <dl className="overview">
      <Figure
        name="Policy"
        value={phaseWords(experiment)}
        note={live ? experiment.phase_detail : "Reconnecting…"}
      />
      <Figure
        name="Steps"
        value={formatCompact(steps)}
        note={`of ${formatCompact(Number(config.total_steps))}`}
      />
      <Figure
        name="Labels"
        value={formatCount(labels.labels)}
        note={`of ${formatCount(labels.budget)}, ${formatCount(labels.due)} due by now, ${formatCount(labels.skips)} skipped`}
      />
      <Figure
        name="Reward version"
        value={experiment.reward_version === null ? "none yet" : String(experiment.reward_version)}
        note={accuracy === null ? "" : `right on ${formatPercent(accuracy)} of held-out labels`}
      />
      <Figure
        name="Open pairs"
        value={formatCount(labels.open_queries)}
        note={
          labels.rendering_queries > 0 ? `${formatCount(labels.rendering_queries)} wait for their clips` : ""
        }
      />
    </dl>
  );
}

function Figure({ name, value, note }: { name: string; value: string; note: string }) {
  return (
    <div className="card figure">
      <dt>{name}</dt>
      <dd>
        <span className="figure-value">{value}</span>
        <span className="quiet">{note}</span>
      </dd>
    </div>
  );
}
