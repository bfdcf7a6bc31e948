import type { Experiment } from "@/shared/api/types";
import { paths } from "@/shared/routing/paths";
import { Link } from "@/shared/routing/router";
import { formatCount } from "@/shared/ui/format";
import type { SessionView } from "./session";

interface NoPairProps {
  experiment: Experiment;
  reason: SessionView["reason"];
  error: string | null;
  aspectRatio: number;
}

/** Shown in place of the clips when there is no pair: why, and when the next one comes. */
export function NoPair({ experiment, reason, error, aspectRatio }: NoPairProps) {
  const { title, text } = explain(experiment, reason, error);
  return (
    <section
      className="pair no-pair"
      data-testid="no-pair"
      data-reason={reason ?? "loading"}
      style={{ "--aspect-ratio": aspectRatio } as React.CSSProperties}
    >
      <div role="status" aria-live="polite">
        <h2>{title}</h2>
        <p>{text}</p>
        <p>
          <Link to={paths.experiment(experiment.id)}>View the experiment</Link>
        </p>
      </div>
    </section>
  );
}

function explain(
  experiment: Experiment,
  reason: SessionView["reason"],
  error: string | null,
): { title: string; text: string } {
  if (error)
    return {
      title: "No pair available",
      text: `${error} Your labels are safe. Labelling resumes automatically.`,
    };
  const { labels, steps, config } = experiment;
  switch (reason) {
    case null:
      return { title: "Loading", text: "The first pair is being loaded." };
    case "":
    case "rendering":
      return {
        title: "Rendering clips",
        text: "The next pair appears here automatically, usually within a few seconds.",
      };
    case "policy_training":
      return {
        title: "No labels needed right now",
        text:
          `The policy is training on your labels (${formatCount(steps)} of ` +
          `${formatCount(Number(config.total_steps))} steps). New pairs appear here automatically as it makes ` +
          "progress. You can leave this page open.",
      };
    case "all_labelled":
      return {
        title: "Nothing left to label",
        text:
          labels.labels >= labels.budget
            ? `All ${formatCount(labels.budget)} labels have been given. Thank you.`
            : "You have labelled every available pair. New pairs appear here automatically.",
      };
    case "paused":
      return {
        title: "Paused",
        text: "A researcher has paused this experiment. Labelling continues when it is resumed.",
      };
    case "experiment_over":
      return { title: "This experiment is over", text: "No more labels are needed. Thank you." };
  }
}
