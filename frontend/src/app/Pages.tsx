import { ExperimentPage } from "@/features/experiment/ExperimentPage";
import { ExperimentList } from "@/features/experiments/ExperimentList";
import { NewExperimentPage } from "@/features/experiments/NewExperimentPage";
import { LabelPage } from "@/features/labelling/LabelPage";
import type { Me } from "@/shared/api/types";
import { paths, routeOf } from "@/shared/routing/paths";
import { Link, usePath } from "@/shared/routing/router";
import { Message } from "@/shared/ui/Message";

/** The page of the address bar. */
export function Pages({ me }: { me: Me }) {
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
    case "missing":
      return (
        <Message title="There is no such page">
          <p>
            <Link to={paths.experiments()}>To the experiments</Link>
          </p>
        </Message>
      );
  }
}
