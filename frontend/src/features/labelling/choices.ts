/** A labeller's judgement of a pair. */
export type Choice = "left" | "right" | "equal" | "skip";

/** The label of a choice in the order shown: 1 means that the left clip is better, null skips the pair. */
export const LABELS: Readonly<Record<Choice, number | null>> = {
  left: 1,
  right: 0,
  equal: 0.5,
  skip: null,
};

/** The choice in words, after it was made. */
export const CHOICE_TEXT: Readonly<Record<Choice, string>> = {
  left: "Left is better",
  right: "Right is better",
  equal: "Equally good",
  skip: "Skipped",
};
