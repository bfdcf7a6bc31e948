import { useQuery } from "@tanstack/react-query";
import { rewardVersionsQuery, workersQuery } from "@/shared/api/queries";
import type { Experiment } from "@/shared/api/types";
import { Meter } from "@/shared/ui/Meter";
import {
  formatCompact,
  formatCount,
  formatPercent,
  isOver,
  phaseWords,
  plural,
  workersTrouble,
} from "@/shared/ui/words";
import { holdoutAccuracy } from "./version";

interface StripProps {
  experiment: Experiment;
  labelled: number;
  live: boolean;
}

/** What stays in sight while labelling: who is who, how far the labels are, what the policy makes of them. */
export function Strip({ experiment, labelled, live }: StripProps) {
  return (
    <div className="strip">
      <Legend experiment={experiment} />
      <Progress experiment={experiment} labelled={labelled} />
      <Policy experiment={experiment} live={live} />
    </div>
  );
}

function Legend({ experiment: { task } }: { experiment: Experiment }) {
  return (
    <section className="card" aria-labelledby="legend-title">
      <h2 id="legend-title">
        {plural(task.n_agents, "agent")} <span className="quiet">{task.name}</span>
      </h2>
      <ul className="legend">
        {task.agent_names.map((name, agent) => (
          <li key={name}>
            <span className="swatch" style={{ background: task.agent_colours[agent] }} aria-hidden="true" />
            {name}
          </li>
        ))}
      </ul>
    </section>
  );
}

function Progress({ experiment, labelled }: { experiment: Experiment; labelled: number }) {
  const { labels } = experiment;
  const due = isOver(experiment) ? 0 : Math.max(0, labels.due - labels.labels);
  return (
    <section className="card" aria-labelledby="progress-title">
      <h2 id="progress-title">Labels</h2>
      <Meter
        label="All labels"
        value={labels.labels}
        max={labels.budget}
        words={`${formatCount(labels.labels)} of ${formatCount(labels.budget)}`}
      />
      <dl className="figures">
        <div>
          <dt>By you, now</dt>
          <dd data-testid="mine">{formatCount(labelled)}</dd>
        </div>
        <div>
          <dt>Wanted now</dt>
          <dd data-testid="due">{formatCount(due)}</dd>
        </div>
      </dl>
    </section>
  );
}

function Policy({ experiment, live }: { experiment: Experiment; live: boolean }) {
  const { data: versions } = useQuery(rewardVersionsQuery(experiment.id));
  const { data: workers } = useQuery(workersQuery);
  const trouble = workersTrouble(workers ?? []);
  const total = Number(experiment.config.total_steps);
  const number = experiment.reward_version;
  const accuracy = holdoutAccuracy(versions?.items.find((version) => version.number === number));
  return (
    <section className="card" aria-labelledby="policy-title">
      <h2 id="policy-title">
        Policy <span className="quiet">{phaseWords(experiment)}</span>
      </h2>
      <Meter
        label="Steps trained"
        value={experiment.steps}
        max={total}
        words={`${formatCompact(experiment.steps)} of ${formatCompact(total)}`}
      />
      <p className="policy-line" data-testid="reward-version">
        {number === null
          ? "No reward version yet"
          : `Reward version ${number}${accuracy === null ? "" : `, right on ${formatPercent(accuracy)} of held-out labels`}`}
      </p>
      <p className="policy-line quiet" role="status">
        {live ? (trouble ?? experiment.phase_detail) : "Reconnecting to the server…"}
      </p>
    </section>
  );
}
