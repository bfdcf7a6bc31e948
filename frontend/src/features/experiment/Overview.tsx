import { versionMetric } from "@/shared/api/metrics";
import type { Experiment, RewardVersion } from "@/shared/api/types";
import { formatCompact, formatCount, formatPercent } from "@/shared/ui/format";
import { phaseText } from "@/shared/ui/status";

interface OverviewProps {
  experiment: Experiment;
  versions: readonly RewardVersion[];
  connected: boolean;
}

/** The state of the experiment in five figures. */
export function Overview({ experiment, versions, connected }: OverviewProps) {
  const { labels, steps, config } = experiment;
  const newest = versions.find(({ number }) => number === experiment.reward_version);
  const accuracy = versionMetric(newest, "holdout_accuracy");
  return (
    <dl className="overview">
      <Stat
        name="Policy"
        value={phaseText(experiment)}
        note={connected ? experiment.phase_detail : "Reconnecting…"}
      />
      <Stat
        name="Training steps"
        value={formatCompact(steps)}
        note={`of ${formatCompact(Number(config.total_steps))}`}
      />
      <Stat
        name="Labels"
        value={formatCount(labels.labels)}
        note={`of ${formatCount(labels.budget)}; ${formatCount(labels.due)} due so far, ${formatCount(labels.skips)} skipped`}
      />
      <Stat
        name="Reward version"
        value={experiment.reward_version === null ? "None yet" : String(experiment.reward_version)}
        note={accuracy === null ? "" : `${formatPercent(accuracy)} held-out accuracy`}
      />
      <Stat
        name="Open queries"
        value={formatCount(labels.open_queries)}
        note={
          labels.rendering_queries > 0 ? `${formatCount(labels.rendering_queries)} more being rendered` : ""
        }
      />
    </dl>
  );
}

function Stat({ name, value, note }: { name: string; value: string; note: string }) {
  return (
    <div className="card stat">
      <dt>{name}</dt>
      <dd>
        <span className="stat-value">{value}</span>
        <span className="muted">{note}</span>
      </dd>
    </div>
  );
}
