import type { Queries, Query } from "@/shared/api/types";

/** The pair on screen and two more, loaded ahead. */
const QUEUE_LENGTH = 3;
/** The most pairs that the server leases in one request. */
const MAX_LEASE_COUNT = 16;
const POLL_EMPTY_SECONDS = 1;
const POLL_SECONDS = 3;

interface Callbacks {
  next(count: number): Promise<Queries>;
  release(queryId: string): void;
  /** the pairs that are leased already */
  held(): readonly Query[];
  /** labelled pairs that the server offers again, because it has not received their labels */
  unsent(): ReadonlySet<string>;
  arrived(found: Queries): void;
  failed(error: unknown): void;
}

/** Leases pairs until the queue is full, and polls while the server has too few. */
export class PairSupply {
  readonly #callbacks: Callbacks;
  #fetching = false;
  #stopped = false;
  #timer: ReturnType<typeof setTimeout> | undefined;

  constructor(callbacks: Callbacks) {
    this.#callbacks = callbacks;
  }

  stop(): void {
    this.#stopped = true;
    clearTimeout(this.#timer);
  }

  /** Fetches pairs now instead of at the next poll. */
  async fetch(): Promise<void> {
    const { held, unsent, next, release, arrived, failed } = this.#callbacks;
    if (this.#fetching || this.#stopped || held().length >= QUEUE_LENGTH) return;
    clearTimeout(this.#timer);
    this.#fetching = true;
    try {
      const found = await next(Math.min(MAX_LEASE_COUNT, QUEUE_LENGTH + unsent().size));
      if (this.#stopped) {
        for (const { id } of found.items) release(id);
        return;
      }
      arrived(found);
    } catch (error) {
      failed(error);
    } finally {
      this.#fetching = false;
    }
    const delay = held().length === 0 ? POLL_EMPTY_SECONDS : POLL_SECONDS;
    if (!this.#stopped) this.#timer = setTimeout(() => void this.fetch(), delay * 1000);
  }
}
