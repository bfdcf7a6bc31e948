import { useInfiniteQuery } from "@tanstack/react-query";
import { sentenceOf } from "@/shared/api/errors";
import { experimentsQuery } from "@/shared/api/queries";
import { type Experiment, type Me, runsExperiments } from "@/shared/api/types";
import { paths } from "@/shared/routing/paths";
import { Link } from "@/shared/routing/router";
import { Trouble } from "@/shared/ui/Message";
import { Meter } from "@/shared/ui/Meter";
import { formatCompact, formatCount, phaseWords } from "@/shared/ui/words";
import "./experiments.css";

/** All experiments, with the way to label each. */
export function ExperimentList({ me }: { me: Me }) {
  const { data, error, hasNextPage, isFetchingNextPage, fetchNextPage } = useInfiniteQuery(experimentsQuery);
  const experiments = data?.pages.flatMap(({ items }) => items);
  return (
    <main className="page" id="content">
      <div className="page-head">
        <h1>Experiments</h1>
        {runsExperiments(me) && (
          <Link to={paths.newExperiment()} className="button primary">
            New experiment
          </Link>
        )}
      </div>
      {error && <Trouble>{sentenceOf(error)}</Trouble>}
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
          Show older ones
        </button>
      )}
    </main>
  );
}

function Empty({ me }: { me: Me }) {
  return (
    <p className="quiet">
      {runsExperiments(me)
        ? "There is none yet. Start one: the first pair is ready to label within a minute."
        : "There is none yet. It appears here when a researcher starts one."}
    </p>
  );
}

function Card({ experiment }: { experiment: Experiment }) {
  const { labels } = experiment;
  const total = Number(experiment.config.total_steps);
  const open = experiment.status === "running";
  return (
    <li className="card experiment">
      <div className="experiment-name">
        <h2>
          <Link to={paths.experiment(experiment.id)}>{experiment.name}</Link>
        </h2>
        <span className="quiet">
          {experiment.task.name} · {phaseWords(experiment)}
        </span>
      </div>
      <Meter
        label="Labels"
        value={labels.labels}
        max={labels.budget}
        words={`${formatCount(labels.labels)} of ${formatCount(labels.budget)}`}
      />
      <Meter
        label="Steps"
        value={experiment.steps}
        max={total}
        words={`${formatCompact(experiment.steps)} of ${formatCompact(total)}`}
      />
      <Link
        to={paths.label(experiment.id)}
        className={open ? "button primary" : "button"}
        aria-label={`Label ${experiment.name}`}
      >
        Label
      </Link>
    </li>
  );
}
