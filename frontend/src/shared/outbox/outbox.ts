import { isPassing, sentenceOf } from "@/shared/api/errors";
import type { NewLabel } from "@/shared/api/types";
import { OperationStore, type Storage } from "./store";

/** Something a person did that the server has to learn. */
export type Operation =
  | { id: string; kind: "label"; experimentId: string; queryId: string; body: NewLabel }
  | { id: string; kind: "undo"; experimentId: string; queryId: string };

export type NewOperation =
  | { kind: "label"; experimentId: string; queryId: string; body: NewLabel }
  | { kind: "undo"; experimentId: string; queryId: string };

export interface OutboxState {
  /** labels the server has not acknowledged */
  unsent: number;
  /** why an attempt failed; null when all that has waited since has been sent */
  trouble: string | null;
}

export type Outcome = { operation: Operation; refused: unknown | null };

const FIRST_WAIT_SECONDS = 0.5;
const LONGEST_WAIT_SECONDS = 8;

/**
 * Labels and undos on their way to the server, in the order in which they were made.
 *
 * Each is kept in the browser's storage until the server has acknowledged or refused it, so that neither a
 * reload nor a dead server loses one. They go one at a time: an undo never overtakes its label. What may pass
 * by itself (no network, a restart) is tried again for ever, with growing pauses; what the server refuses is
 * dropped and told to the listeners.
 */
export class Outbox {
  readonly #store: OperationStore;
  readonly #send: (operation: Operation) => Promise<unknown>;
  readonly #watchers = new Set<() => void>();
  readonly #listeners = new Set<(outcome: Outcome) => void>();
  /** Sent at least once: the server may have it although no answer came. */
  readonly #attempted: Set<string>;
  #operations: Operation[];
  #state: OutboxState;
  #sending = false;
  #stopped = false;
  #wait = FIRST_WAIT_SECONDS;
  #timer: ReturnType<typeof setTimeout> | undefined;

  constructor(userId: string, storage: Storage, send: (operation: Operation) => Promise<unknown>) {
    this.#store = new OperationStore(userId, storage);
    this.#send = send;
    this.#operations = this.#store.load();
    this.#attempted = new Set(this.#operations.map(({ id }) => id));
    this.#state = this.#read(null);
    void this.#drain();
  }

  put(operation: NewOperation): void {
    const kept = { ...operation, id: this.#store.newId() };
    this.#store.save(kept);
    this.#operations = [...this.#operations, kept];
    this.#publish(this.#state.trouble);
    void this.#drain();
  }

  /** Takes back a label that has not left yet. False when it may have, so that the server must be told. */
  takeBack(queryId: string): boolean {
    const operation = this.#operations.findLast((one) => one.queryId === queryId);
    if (operation?.kind !== "label" || this.#attempted.has(operation.id)) return false;
    this.#remove(operation);
    this.#publish(this.#state.trouble);
    return true;
  }

  /** Whether anything about this query is still on its way. */
  holds(queryId: string): boolean {
    return this.#operations.some((operation) => operation.queryId === queryId);
  }

  /** Queries whose last word on its way is a label: answered here, though perhaps not yet at the server. */
  labelled(): Set<string> {
    const last = new Map(this.#operations.map(({ queryId, kind }) => [queryId, kind]));
    return new Set([...last].filter(([, kind]) => kind === "label").map(([queryId]) => queryId));
  }

  /** Tries at once: the network is back, or the server. */
  retryNow(): void {
    clearTimeout(this.#timer);
    this.#wait = FIRST_WAIT_SECONDS;
    void this.#drain();
  }

  stop(): void {
    this.#stopped = true;
    clearTimeout(this.#timer);
  }

  readonly state = (): OutboxState => this.#state;

  readonly watch = (watcher: () => void): (() => void) => {
    this.#watchers.add(watcher);
    return () => this.#watchers.delete(watcher);
  };

  /** Calls back with every operation that the server acknowledged or refused. */
  listen(listener: (outcome: Outcome) => void): () => void {
    this.#listeners.add(listener);
    return () => this.#listeners.delete(listener);
  }

  async #drain(): Promise<void> {
    if (this.#sending) return;
    for (let next = this.#operations[0]; next && !this.#stopped; next = this.#operations[0]) {
      this.#sending = true;
      const refused = await this.#attempt(next);
      this.#sending = false;
      if (isPassing(refused)) {
        this.#publish(sentenceOf(refused));
        this.#timer = setTimeout(() => void this.#drain(), this.#wait * 1000);
        this.#wait = Math.min(2 * this.#wait, LONGEST_WAIT_SECONDS);
        return;
      }
      this.#wait = FIRST_WAIT_SECONDS;
      this.#remove(next);
      this.#publish(this.#operations.length > 0 ? this.#state.trouble : null);
      for (const listener of this.#listeners) listener({ operation: next, refused });
    }
  }

  /** Null when the server took it. */
  async #attempt(operation: Operation): Promise<unknown | null> {
    this.#attempted.add(operation.id);
    try {
      await this.#send(operation);
      return null;
    } catch (error) {
      return error;
    }
  }

  #remove(operation: Operation): void {
    this.#store.remove(operation.id);
    this.#operations = this.#operations.filter(({ id }) => id !== operation.id);
  }

  #publish(trouble: string | null): void {
    this.#state = this.#read(trouble);
    for (const watcher of this.#watchers) watcher();
  }

  #read(trouble: string | null): OutboxState {
    return { unsent: this.#operations.filter(({ kind }) => kind === "label").length, trouble };
  }
}
