import { useInfiniteQuery } from "@tanstack/react-query";
import { errorMessage } from "@/shared/api/errors";
import { experimentsQuery } from "@/shared/api/queries";
import { canManageExperiments, type Experiment, type Me } from "@/shared/api/types";
import { paths } from "@/shared/routing/paths";
import { Link } from "@/shared/routing/router";
import { formatCompact, formatCount } from "@/shared/ui/format";
import { Alert } from "@/shared/ui/Message";
import { ProgressBar } from "@/shared/ui/ProgressBar";
import { phaseText } from "@/shared/ui/status";
import "./experiment-list.css";

/** All experiments, newest first, each with a link to label it. */
export function ExperimentList({ me }: { me: Me }) {
  const { data, error, hasNextPage, isFetchingNextPage, fetchNextPage } = useInfiniteQuery(experimentsQuery);
  const experiments = data?.pages.flatMap(({ items }) => items);
  return (
    <main className="page" id="content">
      <div className="page-head">
        <h1>Experiments</h1>
        {canManageExperiments(me) && (
          <Link to={paths.newExperiment()} className="button primary">
            New experiment
          </Link>
        )}
      </div>
      {error && <Alert>{errorMessage(error)}</Alert>}
      {experiments?.length === 0 && <Empty me={me} />}
      <ul className="experiments">
        {experiments?.map((experiment) => (
          <Card key={experiment.id} experiment={experiment} />
        ))}
      </ul>
      {hasNextPage && (
        <button
          type="button"
          className="button"
          disabled={isFetchingNextPage}
          onClick={() => void fetchNextPage()}
        >
          Show older experiments
        </button>
      )}
    </main>
  );
}

function Empty({ me }: { me: Me }) {
  return (
    <p className="muted">
      {canManageExperiments(me)
        ? "No experiments yet. Start one: the first pair is ready to label within a minute."
        : "No experiments yet. Experiments appear here when a researcher starts them."}
    </p>
  );
}

function Card({ experiment }: { experiment: Experiment }) {
  const { labels } = experiment;
  const total = Number(experiment.config.total_steps);
  const needsLabels =
    experiment.status === "running" &&
    experiment.config.reward_source !== "true" &&
    labels.labels < labels.budget;
  return (
    <li className="card experiment">
      <div className="experiment-name">
        <h2>
          <Link to={paths.experiment(experiment.id)}>{experiment.name}</Link>
        </h2>
        <span className="muted">
          {experiment.task.name} · {phaseText(experiment)}
        </span>
      </div>
      <ProgressBar
        label="Labels"
        value={labels.labels}
        max={labels.budget}
        text={`${formatCount(labels.labels)} of ${formatCount(labels.budget)}`}
      />
      <ProgressBar
        label="Training steps"
        value={experiment.steps}
        max={total}
        text={`${formatCompact(experiment.steps)} of ${formatCompact(total)}`}
      />
      <Link
        to={paths.label(experiment.id)}
        className={needsLabels ? "button primary" : "button"}
        aria-label={`Label ${experiment.name}`}
      >
        Label
      </Link>
    </li>
  );
}
