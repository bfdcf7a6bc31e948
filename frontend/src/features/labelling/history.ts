import { isTransient } from "@/shared/api/errors";
import type { OwnLabels } from "@/shared/api/types";

/** Labels that are loaded at first, and more at a time on request. */
const PAGE_LENGTH = 24;

interface Callbacks {
  request(limit: number, before: number | null): Promise<OwnLabels>;
  /** whether the server knows every label that was given in this browser */
  isSynchronised(): boolean;
  /** called with the newest labels, or with older ones than those that were loaded */
  loaded(found: OwnLabels, older: boolean): void;
}

/**
 * Loads the labels that the user has given in this experiment, in any tab or browser.
 *
 * A response that was overtaken by a label given here is dropped: the caller loads again once that label is stored.
 */
export class HistoryLoader {
  readonly #callbacks: Callbacks;
  #changes = 0;
  #before: number | null = null;

  constructor(callbacks: Callbacks) {
    this.#callbacks = callbacks;
  }

  /** The user has labelled, changed or undone a label here. */
  changed(): void {
    this.#changes += 1;
  }

  /** Whether there are older labels than those that were loaded. */
  get hasOlder(): boolean {
    return this.#before !== null;
  }

  async load(older = false): Promise<void> {
    if (!this.#callbacks.isSynchronised() || (older && !this.hasOlder)) return;
    const changes = this.#changes;
    try {
      const found = await this.#callbacks.request(PAGE_LENGTH, older ? this.#before : null);
      if (changes !== this.#changes || !this.#callbacks.isSynchronised()) return;
      this.#before = found.next_before;
      this.#callbacks.loaded(found, older);
    } catch (error) {
      // The server or the connection is down: the page says so, and this is loaded with the next pairs.
      if (!isTransient(error)) throw error;
    }
  }
}
