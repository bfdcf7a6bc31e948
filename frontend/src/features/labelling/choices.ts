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
