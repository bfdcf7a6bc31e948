import { useQuery } from "@tanstack/react-query";
import { sentenceOf } from "@/shared/api/errors";
import { experimentQuery, metricsQuery, rewardVersionsQuery } from "@/shared/api/queries";
import { type Me, runsExperiments, seesReturns } from "@/shared/api/types";
import { useLive } from "@/shared/live/useLive";
import { paths } from "@/shared/routing/paths";
import { Link } from "@/shared/routing/router";
import { Message } from "@/shared/ui/Message";
import { Controls } from "./Controls";
import { Curves } from "./Curves";
import { Overview } from "./Overview";
import { Settings } from "./Settings";
import { Versions } from "./Versions";
import { Workers } from "./Workers";
import "./experiment.css";

/** How one experiment does, as it happens. */
export function ExperimentPage({ id, me }: { id: string; me: Me }) {
  const experiment = useQuery(experimentQuery(id));
  const metrics = useQuery(metricsQuery(id));
  const versions = useQuery(rewardVersionsQuery(id));
  const live = useLive(id);
  if (experiment.error && !experiment.data) {
    return (
      <Message title="This experiment cannot be opened">
        <p>{sentenceOf(experiment.error)}</p>
        <p>
          <Link to={paths.experiments()}>To the experiments</Link>
        </p>
      </Message>
    );
  }
  if (!experiment.data) return null;
  const items = versions.data?.items ?? [];
  return (
    <main className="page" id="content">
      <div className="page-head">
        <div>
          <h1>{experiment.data.name}</h1>
          <p className="quiet">{experiment.data.instructions}</p>
        </div>
        <div className="row">
          {runsExperiments(me) && <Controls experiment={experiment.data} />}
          <Link to={paths.label(id)} className="button primary">
            Label
          </Link>
        </div>
      </div>
      <Overview experiment={experiment.data} versions={items} live={live} />
      <Curves
        experiment={experiment.data}
        metrics={metrics.data}
        versions={items}
        withTrueReturn={seesReturns(me)}
      />
      <div className="columns">
        <Versions versions={items} />
        <div>
          <Workers />
          <Settings experiment={experiment.data} />
        </div>
      </div>
    </main>
  );
}
