import { versionMetric } from "@/shared/api/metrics";
import type { RewardVersion } from "@/shared/api/types";
import { formatCompact, formatCount, formatPercent, formatTime } from "@/shared/ui/format";

/** A table of all reward versions, newest first, with their metrics on held-out labels. */
export function Versions({ versions }: { versions: readonly RewardVersion[] }) {
  return (
    <section className="card" aria-labelledby="versions-title">
      <h2 id="versions-title">Reward versions</h2>
      {versions.length === 0 ? (
        <p className="muted">None yet. The first version is trained on the initial labels.</p>
      ) : (
        <table className="table" data-testid="versions">
          <thead>
            <tr>
              <th scope="col">Version</th>
              <th scope="col">Labels</th>
              <th scope="col">Training steps</th>
              <th scope="col">Held-out accuracy</th>
              <th scope="col">Held-out loss</th>
              <th scope="col">Attention</th>
              <th scope="col">Created</th>
            </tr>
          </thead>
          <tbody>
            {[...versions]
              .sort((a, b) => b.number - a.number)
              .map((version) => (
                <Row key={version.id} version={version} />
              ))}
          </tbody>
        </table>
      )}
    </section>
  );
}

/** Whether rewards depend on attention, and the reduction of the held-out loss that the latest trial measured. */
function attention(version: RewardVersion): string {
  const inUse = versionMetric(version, "attention");
  if (inUse === null) return "–";
  const gain = versionMetric(version, "attention_gain");
  const error = versionMetric(version, "attention_gain_error");
  const state = inUse ? "in use" : "not in use";
  return gain === null || error === null ? state : `${state}, ${gain.toFixed(3)} ± ${error.toFixed(3)}`;
}

function trialTitle(version: RewardVersion): string | undefined {
  const pairs = versionMetric(version, "attention_gain_pairs");
  const labels = versionMetric(version, "attention_trial_labels");
  if (pairs === null || labels === null) return undefined;
  const seconds = versionMetric(version, "attention_trial_seconds");
  const spent = seconds ? ` This version spent ${seconds.toFixed(0)} s on it.` : "";
  return `Reduction of the held-out loss in nats ± standard error on ${formatCount(pairs)} pairs, at ${formatCount(labels)} labels.${spent}`;
}

function Row({ version }: { version: RewardVersion }) {
  const accuracy = versionMetric(version, "holdout_accuracy");
  const loss = versionMetric(version, "holdout_loss");
  return (
    <tr>
      <th scope="row">{version.number}</th>
      <td>{formatCount(version.label_count)}</td>
      <td>{formatCompact(version.policy_steps)}</td>
      <td>{accuracy === null ? "–" : formatPercent(accuracy)}</td>
      <td>{loss === null ? "–" : loss.toFixed(3)}</td>
      <td title={trialTitle(version)}>{attention(version)}</td>
      <td>{formatTime(version.created_at)}</td>
    </tr>
  );
}
