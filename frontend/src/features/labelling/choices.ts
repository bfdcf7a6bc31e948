import type { NewLabel } from "@/shared/api/types";

const MAX_RESPONSE_SECONDS = 86_400;

/** A labeller's judgement of a pair. */
export type Choice = "left" | "right" | "equal" | "skip";

/** The label of a choice in the order shown: 1 means that the left clip is better, null skips the pair. */
export const LABELS: Readonly<Record<Choice, number | null>> = {
  left: 1,
  right: 0,
  equal: 0.5,
  skip: null,
};

/** Skips do not count as labels. */
export function countOf(choice: Choice): number {
  return choice === "skip" ? 0 : 1;
}

/**
 * The request that stores a choice.
 *
 * @param revision of the label that it changes; null for the first label of the pair in this session
 * @param decides whether it is final
 * @param rules the revision of the instructions that the labeller has read
 */
export function labelBody(
  choice: Choice,
  responseSeconds: number,
  revision: number | null,
  decides: boolean,
  rules: number,
): NewLabel {
  return {
    // A final label also replaces the label that its author has given like any other labeller.
    replaces: revision ?? (decides ? null : 0),
    final: decides || null,
    label: LABELS[choice],
    order: "shown",
    instructions_revision: rules,
    response_seconds: Math.min(MAX_RESPONSE_SECONDS, Math.max(0, responseSeconds)),
  };
}
