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
      <td>{formatTime(version.created_at)}</td>
    </tr>
  );
}
