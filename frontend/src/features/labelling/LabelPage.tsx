import { useQuery } from "@tanstack/react-query";
import { errorMessage } from "@/shared/api/errors";
import { experimentQuery } from "@/shared/api/queries";
import { useLiveUpdates } from "@/shared/api/useLiveUpdates";
import { paths } from "@/shared/routing/paths";
import { Link } from "@/shared/routing/router";
import { Message } from "@/shared/ui/Message";
import { LabelView } from "./LabelView";
import "./clips.css";
import "./labelling.css";
import "./small-screens.css";

/** The page on which a person compares pairs of clips. */
export function LabelPage({ id }: { id: string }) {
  const experiment = useQuery(experimentQuery(id));
  const connected = useLiveUpdates(id);
  if (experiment.data) return <LabelView experiment={experiment.data} connected={connected} />;
  if (experiment.error) {
    return (
      <Message title="Cannot open this experiment">
        <p>{errorMessage(experiment.error)}</p>
        <p>
          <Link to={paths.experiments()}>All experiments</Link>
        </p>
      </Message>
    );
  }
  return null;
}
