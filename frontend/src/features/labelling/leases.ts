import { isPassing } from "@/shared/api/errors";
import type { Query } from "@/shared/api/types";

/** Of three heartbeats within a lease two may fail. */
const BEATS_PER_LEASE = 3;
/** Someone who has not touched the page for this long has gone: the pairs go back to the others. */
const PRESENT_SECONDS = 600;

interface Wishes {
  /** the pairs whose leases are to be kept */
  held(): readonly Query[];
  heartbeat(queryId: string): Promise<unknown>;
  /** a lease that is gone for good */
  lost(queryId: string, error: unknown): void;
}

/** Keeps the leases of the pairs on screen and of those loaded ahead, while someone is there to look at them. */
export class Leases {
  readonly #wishes: Wishes;
  #lastSeen = Date.now();
  #timer: ReturnType<typeof setTimeout> | undefined;

  constructor(wishes: Wishes) {
    this.#wishes = wishes;
    this.#plan();
  }

  /** The person did something: a key, a click, or came back to the tab. */
  seen(): void {
    const wasAway = !this.#present();
    this.#lastSeen = Date.now();
    if (wasAway) void this.#beat();
  }

  stop(): void {
    clearTimeout(this.#timer);
  }

  #present(): boolean {
    return Date.now() - this.#lastSeen < PRESENT_SECONDS * 1000;
  }

  #plan(): void {
    const shortest = Math.min(60, ...this.#wishes.held().map(({ lease_seconds }) => lease_seconds));
    this.#timer = setTimeout(
      () => {
        if (this.#present()) void this.#beat();
        this.#plan();
      },
      (shortest * 1000) / BEATS_PER_LEASE,
    );
  }

  async #beat(): Promise<void> {
    await Promise.all(
      this.#wishes.held().map(async ({ id }) => {
        try {
          await this.#wishes.heartbeat(id);
        } catch (error) {
          if (!isPassing(error)) this.#wishes.lost(id, error);
        }
      }),
    );
  }
}
