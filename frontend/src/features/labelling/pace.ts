import type { Choice } from "./choices";

/**
 * So many equal answers in a row are unlikely by chance: sides are randomised, so that twelve times the same side has a
 * probability of 1 in 2,048.
 */
const RUN = 12;
/** Nobody watches two clips, compares them and presses a key in less. Equal answers that take longer are a judgement. */
const FAST_SECONDS = 1;

/** Notices when somebody gives the same answer very quickly again and again. */
export class Pace {
  #last: Choice | null = null;
  #seconds: number[] = [];

  /** Whether the last answers were all the same and very quick. */
  get isHasty(): boolean {
    const sorted = [...this.#seconds].sort((one, other) => one - other);
    return sorted.length >= RUN && (sorted[RUN >> 1] ?? FAST_SECONDS) < FAST_SECONDS;
  }

  add(choice: Choice, seconds: number): void {
    if (choice !== this.#last) this.#seconds = [];
    this.#last = choice;
    this.#seconds = [...this.#seconds, seconds].slice(-RUN);
  }

  /** Counts from the beginning, so that the notice comes back only after another run. */
  reset(): void {
    this.#last = null;
    this.#seconds = [];
  }
}
