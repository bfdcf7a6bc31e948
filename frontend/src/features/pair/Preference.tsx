import type { Credit } from "@/shared/api/types";
import { formatPercent } from "@/shared/ui/format";

const ENSEMBLE_IS_MISSING = "The ensemble of this version is not trained yet, so its spread is unknown.";
const NO_ENSEMBLE =
  "One model, without an ensemble, so there is no spread. For one, clone the experiment and set Query selection to disagreement or entropy.";

interface PreferenceProps {
  credit: Credit;
  result: NonNullable<Credit["result"]>;
}

/** P(left is better) of the reward version, and of each member of its ensemble. */
export function Preference({ credit, result }: PreferenceProps) {
  const ofLeft = (probability: number) => (credit.query.left.index === 0 ? probability : 1 - probability);
  const left = ofLeft(result.probability);
  const members = result.member_probabilities.map(ofLeft);
  return (
    <section className="card preference" aria-labelledby="preference-title">
      <h2 id="preference-title">
        P(left is better) <span className="number">{formatPercent(left)}</span>
      </h2>
      <svg viewBox="0 0 100 10" preserveAspectRatio="none" aria-hidden="true">
        <rect width="100" height="10" className="preference-rest" />
        <rect width={100 * left} height="10" className="preference-left" />
        <rect x="49.9" width="0.2" height="10" className="preference-half" />
        {members.map((member, index) => (
          // biome-ignore lint/suspicious/noArrayIndexKey: members have no other name
          <rect key={index} x={100 * member - 0.2} width="0.4" height="10" className="preference-member" />
        ))}
      </svg>
      <p className="muted">{result.lacks_ensemble ? ENSEMBLE_IS_MISSING : membersText(members)}</p>
    </section>
  );
}

function membersText(members: readonly number[]): string {
  if (members.length === 0) return NO_ENSEMBLE;
  const mean = members.reduce((sum, value) => sum + value, 0) / members.length;
  const spread = Math.sqrt(members.reduce((sum, value) => sum + (value - mean) ** 2, 0) / members.length);
  return `Ensemble of ${members.length}: ${members.map(formatPercent).join(", ")}; standard deviation ${formatPercent(spread)}.`;
}
