import { keepPreviousData, useQuery } from "@tanstack/react-query";
import { costsQuery } from "@/shared/api/queries";
import type { Experiment } from "@/shared/api/types";
import { formatCount, formatDuration, plural } from "@/shared/ui/format";
import { ExportButton } from "./ExportButton";

const BYTES_PER_MB = 1e6;

/** What the experiment has cost so far: people's time, machine time and storage. */
export function Costs({ experiment }: { experiment: Experiment }) {
  const { data: costs } = useQuery({
    ...costsQuery(experiment),
    placeholderData: keepPreviousData,
    refetchInterval: experiment.status === "running" ? 15_000 : false,
  });
  if (!costs) return null;
  const perAnswer = costs.person_answers > 0 ? costs.person_seconds / costs.person_answers : 0;
  return (
    <section className="card" aria-labelledby="costs-title">
      <h2 id="costs-title">Costs and data</h2>
      <table className="table">
        <tbody>
          <tr>
            <th scope="row">People</th>
            <td>
              {costs.person_answers === 0
                ? "no labels"
                : `${formatDuration(costs.person_seconds)} by ${plural(costs.people, "person", "people")}: ` +
                  `${formatCount(costs.person_answers)} labels and skips, ${perAnswer.toFixed(1)} s each`}
            </td>
          </tr>
          <tr>
            <th scope="row">Programs</th>
            <td>{costs.program_labels === 0 ? "no labels" : plural(costs.program_labels, "label")}</td>
          </tr>
          <tr>
            <th scope="row">Policy training</th>
            <td>{formatDuration(costs.policy_seconds)}, without waiting and evaluations</td>
          </tr>
          <tr>
            <th scope="row">Reward training</th>
            <td>{formatDuration(costs.reward_seconds)}, without ensembles</td>
          </tr>
          <tr>
            <th scope="row">Storage</th>
            <td>
              {plural(costs.segments, "segment")}, {plural(costs.clips, "clip")}
              {costs.clips > 0 && ` of ${formatCount(Math.ceil(costs.clip_bytes / BYTES_PER_MB))} MB`}
            </td>
          </tr>
        </tbody>
      </table>
      {costs.segments > 0 && <ExportButton experimentId={experiment.id} />}
    </section>
  );
}
