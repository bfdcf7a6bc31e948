import type { Experiment } from "@/shared/api/types";
import { paths } from "@/shared/routing/paths";
import { Link } from "@/shared/routing/router";
import { formatCount } from "@/shared/ui/words";
import type { SessionView } from "./session";

interface WaitingProps {
  experiment: Experiment;
  reason: SessionView["reason"];
  trouble: string | null;
  ratio: number;
}

/** In the place of the clips when there is no pair: why, and when it goes on. */
export function Waiting({ experiment, reason, trouble, ratio }: WaitingProps) {
  const { title, text } = wordsOf(experiment, reason, trouble);
  return (
    <section
      className="stage waiting"
      data-testid="waiting"
      data-reason={reason ?? "asking"}
      style={{ "--ratio": ratio } as React.CSSProperties}
    >
      <div role="status" aria-live="polite">
        <h2>{title}</h2>
        <p>{text}</p>
        <p>
          <Link to={paths.experiment(experiment.id)}>See how the policy does</Link>
        </p>
      </div>
    </section>
  );
}

/** A title and one or two sentences. */
export function wordsOf(
  experiment: Experiment,
  reason: SessionView["reason"],
  trouble: string | null,
): { title: string; text: string } {
  if (trouble)
    return { title: "No pair for now", text: `${trouble} Your labels are safe; this goes on by itself.` };
  const { labels } = experiment;
  switch (reason) {
    case null:
      return { title: "One moment", text: "The first pair is on its way." };
    case "":
    case "rendering":
      return {
        title: "Clips are being made",
        text: "The next pair appears here by itself, in a few seconds as a rule.",
      };
    case "policy_training":
      return {
        title: "All labels wanted so far are in",
        text:
          `The policy is learning from them (${formatCount(experiment.steps)} of ` +
          `${formatCount(Number(experiment.config.total_steps))} steps). New pairs appear here by themselves as it ` +
          "moves on. This page can stay open.",
      };
    case "all_labelled":
      return {
        title: "Nothing left for you to label",
        text:
          labels.labels >= labels.budget
            ? `All ${formatCount(labels.budget)} labels are in. Thank you.`
            : "You have seen every pair there is. New ones appear here by themselves.",
      };
    case "paused":
      return {
        title: "Paused",
        text: "Whoever runs this experiment has paused it. It goes on here once they resume it.",
      };
    case "experiment_over":
      return { title: "This experiment is over", text: "It asks for no more labels. Thank you for yours." };
  }
}
