import { useQuery } from "@tanstack/react-query";
import { sentenceOf } from "@/shared/api/errors";
import { experimentQuery } from "@/shared/api/queries";
import type { Me } from "@/shared/api/types";
import { useLive } from "@/shared/live/useLive";
import { paths } from "@/shared/routing/paths";
import { Link } from "@/shared/routing/router";
import { Message } from "@/shared/ui/Message";
import { Workbench } from "./Workbench";
import "./labelling.css";

/** Compare pairs of clips, one after the other. */
export function LabelPage({ id, me }: { id: string; me: Me }) {
  const experiment = useQuery(experimentQuery(id));
  const live = useLive(id);
  if (experiment.data) return <Workbench experiment={experiment.data} me={me} live={live} />;
  if (experiment.error) {
    return (
      <Message title="This experiment cannot be opened">
        <p>{sentenceOf(experiment.error)}</p>
        <p>
          <Link to={paths.experiments()}>To the experiments</Link>
        </p>
      </Message>
    );
  }
  return null;
}
