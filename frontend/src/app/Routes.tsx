import { ComparePage } from "@/features/compare/ComparePage";
import { ExperimentPage } from "@/features/experiment/ExperimentPage";
import { ExperimentList } from "@/features/experiment-list/ExperimentList";
import { LabelPage } from "@/features/labelling/LabelPage";
import { NewExperimentPage } from "@/features/new-experiment/NewExperimentPage";
import type { Me } from "@/shared/api/types";
import { paths, routeOf } from "@/shared/routing/paths";
import { Link, usePath } from "@/shared/routing/router";
import { Message } from "@/shared/ui/Message";

/** Renders the page of the current URL. */
export function Routes({ me }: { me: Me }) {
  const route = routeOf(usePath());
  switch (route.page) {
    case "experiments":
      return <ExperimentList me={me} />;
    case "new-experiment":
      return <NewExperimentPage me={me} />;
    case "experiment":
      return <ExperimentPage key={route.id} id={route.id} me={me} />;
    case "label":
      return <LabelPage key={route.id} id={route.id} me={me} />;
    case "compare":
      return <ComparePage key={route.ids.join()} ids={route.ids} />;
    case "missing":
      return (
        <Message title="Page not found">
          <p>
            <Link to={paths.experiments()}>All experiments</Link>
          </p>
        </Message>
      );
  }
}
