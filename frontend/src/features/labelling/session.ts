import { errorMessage, isTransient } from "@/shared/api/errors";
import type { Queries, Query } from "@/shared/api/types";
import type { Outbox, Outcome } from "@/shared/outbox/outbox";
import { type Choice, LABELS } from "./choices";
import { LeaseKeeper } from "./leases";
import { append, EMPTY, type LabelledPair, labelFirst, type Queue, remove, undoLast } from "./queue";
import { loadState, saveState, type TabStorage } from "./savedState";

/** The pair on screen and two more, loaded ahead. */
const QUEUE_LENGTH = 3;
/** The most pairs that the server leases in one request. */
const MAX_LEASE_COUNT = 16;
/** How long the chosen side stays highlighted before the next pair is shown. */
const HIGHLIGHT_SECONDS = 0.22;
const POLL_EMPTY_SECONDS = 1;
const POLL_SECONDS = 3;
const MAX_RESPONSE_SECONDS = 86_400;

/** What the page shows. Replaced by a new object on every change. */
export interface SessionView {
  current: Query | null;
  upcoming: readonly Query[];
  last: LabelledPair | null;
  /** the choice just made, while its pair is still on screen */
  chosen: Choice | null;
  /** why there is no pair; null before the first response */
  reason: Queries["reason"] | null;
  /** why pairs cannot be loaded: the server is unreachable or responded with an error */
  error: string | null;
  /** a message about the last action; null for none */
  notice: string | null;
  /** labels given in this tab, without skips */
  labelCount: number;
  /** increases with every pair displayed, also after undo */
  displayCount: number;
}

export const INITIAL_VIEW: SessionView = {
  current: null,
  upcoming: [],
  last: null,
  chosen: null,
  reason: null,
  error: null,
  notice: null,
  labelCount: 0,
  displayCount: 0,
};

/** The requests of a labelling session. */
export interface LabellingServer {
  next(count: number): Promise<Queries>;
  heartbeat(queryId: string): Promise<unknown>;
  release(queryId: string): void;
}

interface Dependencies {
  experimentId: string;
  server: LabellingServer;
  outbox: Outbox;
  storage: TabStorage;
  storageKey: string;
}

/** One person labelling one experiment: the pair on screen, the pairs ahead of it, and those that can be undone. */
export class LabellingSession {
  readonly #deps: Dependencies;
  readonly #leases: LeaseKeeper;
  readonly #subscribers = new Set<() => void>();
  readonly #stopListening: () => void;
  /** Queries labelled here and not undone. The server may still offer them until it has received the label. */
  readonly #labelled = new Set<string>();
  #queue: Queue;
  #view: SessionView;
  #fetching = false;
  #disposed = false;
  #pollTimer: ReturnType<typeof setTimeout> | undefined;
  #highlightTimer: ReturnType<typeof setTimeout> | undefined;

  constructor(deps: Dependencies) {
    this.#deps = deps;
    const { labelCount, past } = loadState(deps.storage, deps.storageKey);
    this.#queue = { ...EMPTY, past };
    this.#view = { ...INITIAL_VIEW, last: past.at(-1) ?? null, labelCount };
    this.#stopListening = deps.outbox.listen((outcome) => this.#handleOutcome(outcome));
    this.#leases = new LeaseKeeper({
      held: () => this.#queue.pairs.filter(({ id }) => !this.#isBeingLabelled(id)),
      heartbeat: (id) => deps.server.heartbeat(id),
      lost: (id) => {
        // A heartbeat that arrives after the label fails, because the label has closed the query.
        if (this.#isBeingLabelled(id)) return;
        this.#drop(id, "The pair was given to another labeller because it was open for too long.");
      },
    });
    void this.#fetch();
  }

  readonly view = (): SessionView => this.#view;

  /** Calls back after every change of the view. Returns a function that unsubscribes. */
  readonly subscribe = (callback: () => void): (() => void) => {
    this.#subscribers.add(callback);
    return () => this.#subscribers.delete(callback);
  };

  /** Labels the pair on screen. The label is stored at once; the next pair follows after the highlight. */
  choose(choice: Choice, responseSeconds: number): void {
    const query = this.#view.current;
    if (!query || this.#view.chosen) return;
    this.#leases.userActive();
    const body = {
      label: LABELS[choice],
      order: "shown" as const,
      response_seconds: Math.min(MAX_RESPONSE_SECONDS, Math.max(0, responseSeconds)),
    };
    this.#labelled.add(query.id);
    const { experimentId, outbox } = this.#deps;
    outbox.add({ kind: "label", experimentId, queryId: query.id, body });
    this.#publish({ chosen: choice, notice: null });
    this.#highlightTimer = setTimeout(() => this.#advance(choice), HIGHLIGHT_SECONDS * 1000);
  }

  /** Removes the last label and shows its pair again. */
  undo(): void {
    this.#leases.userActive();
    if (this.#view.chosen) {
      clearTimeout(this.#highlightTimer);
      this.#advance(this.#view.chosen);
    }
    const last = this.#queue.past.at(-1);
    if (!last) {
      this.#publish({ notice: "Nothing to undo." });
      return;
    }
    const { id } = last.query;
    const { experimentId, outbox } = this.#deps;
    if (!outbox.cancelLabel(id)) outbox.add({ kind: "undo", experimentId, queryId: id });
    this.#labelled.delete(id);
    this.#queue = undoLast(this.#queue);
    const labelCount = this.#view.labelCount - countOf(last.choice);
    this.#show({ notice: "Undone. Label this pair again.", labelCount });
  }

  /** The user moved the mouse or pressed a key. */
  userActive(): void {
    this.#leases.userActive();
  }

  /** Fetches pairs now instead of at the next poll: the user is back, or the experiment has changed. */
  refresh(): void {
    this.#leases.userActive();
    void this.#fetch();
  }

  /** Ends the session and releases its pairs. The outbox still sends the labels that are waiting. */
  dispose(): void {
    this.#disposed = true;
    clearTimeout(this.#pollTimer);
    clearTimeout(this.#highlightTimer);
    this.#stopListening();
    this.#leases.stop();
    const held = this.#queue.pairs.filter(({ id }) => !this.#labelled.has(id));
    for (const { id } of held) this.#deps.server.release(id);
  }

  /** Whether the query was labelled here, or its label or undo is still being sent: it needs no lease. */
  #isBeingLabelled(id: string): boolean {
    return this.#labelled.has(id) || this.#deps.outbox.has(id);
  }

  #advance(choice: Choice): void {
    this.#queue = labelFirst(this.#queue, choice);
    this.#show({ chosen: null, labelCount: this.#view.labelCount + countOf(choice) });
    void this.#fetch();
  }

  #handleOutcome({ operation, error }: Outcome): void {
    if (error === null) return;
    const { queryId, kind } = operation;
    const labelledHere = this.#queue.past.find(({ query }) => query.id === queryId);
    const what = kind === "label" ? "A label was rejected" : "The undo was rejected";
    if (kind === "label" && labelledHere)
      this.#publish({ labelCount: this.#view.labelCount - countOf(labelledHere.choice) });
    this.#labelled.delete(queryId);
    this.#drop(queryId, `${what}: ${errorMessage(error)}`);
  }

  /** Removes a pair; shows the notice if the user has seen the pair. */
  #drop(id: string, notice: string): void {
    const onScreen = this.#view.current?.id === id;
    const seen = onScreen || this.#queue.past.some(({ query }) => query.id === id);
    this.#queue = remove(this.#queue, id);
    if (onScreen) clearTimeout(this.#highlightTimer);
    this.#show(onScreen ? { chosen: null, notice } : seen ? { notice } : {});
    void this.#fetch();
  }

  /** Leases pairs until the queue is full; polls while the server has too few. */
  async #fetch(): Promise<void> {
    if (this.#fetching || this.#disposed || this.#queue.pairs.length >= QUEUE_LENGTH) return;
    clearTimeout(this.#pollTimer);
    this.#fetching = true;
    try {
      const unsent = this.#deps.outbox.labelledQueries();
      const count = Math.min(MAX_LEASE_COUNT, QUEUE_LENGTH + unsent.size);
      const { items, reason } = await this.#deps.server.next(count);
      if (this.#disposed) {
        for (const { id } of items) this.#deps.server.release(id);
        return;
      }
      this.#queue = append(this.#queue, items, new Set([...this.#labelled, ...unsent]));
      this.#show({ reason, error: null });
    } catch (error) {
      this.#publish({ error: errorMessage(error), reason: isTransient(error) ? this.#view.reason : "" });
    } finally {
      this.#fetching = false;
    }
    const delay = this.#queue.pairs.length === 0 ? POLL_EMPTY_SECONDS : POLL_SECONDS;
    if (!this.#disposed) this.#pollTimer = setTimeout(() => void this.#fetch(), delay * 1000);
  }

  /** Publishes the state of the queue and saves what survives a reload. */
  #show(change: Partial<SessionView>): void {
    const current = this.#queue.pairs[0] ?? null;
    const changed = current !== null && current.id !== this.#view.current?.id;
    this.#publish({
      ...change,
      current,
      upcoming: this.#queue.pairs.slice(1),
      last: this.#queue.past.at(-1) ?? null,
      displayCount: this.#view.displayCount + (changed ? 1 : 0),
    });
    const { storage, storageKey } = this.#deps;
    saveState(storage, storageKey, { labelCount: this.#view.labelCount, past: this.#queue.past });
  }

  #publish(change: Partial<SessionView>): void {
    this.#view = { ...this.#view, ...change };
    for (const callback of this.#subscribers) callback();
  }
}

/** Skips do not count as labels. */
function countOf(choice: Choice): number {
  return choice === "skip" ? 0 : 1;
}
