import { isPassing, sentenceOf } from "@/shared/api/errors";
import type { Queries, Query } from "@/shared/api/types";
import type { Outbox, Outcome } from "@/shared/outbox/outbox";
import { type Answer, LABEL_OF } from "./answers";
import { Leases } from "./leases";
import { type MemoryStorage, recall, remember } from "./memory";
import { type Answered, answered, dropped, EMPTY, offered, type Queue, undone } from "./queue";
import type { LabellingServer } from "./server";

/** The pair on screen and the two loaded ahead. */
const WANTED = 3;
/** The most the server gives at once. */
const MOST = 16;
/** How long the chosen side stays outlined before the next pair is shown. */
const FLASH_SECONDS = 0.22;
const POLL_EMPTY_SECONDS = 1;
const POLL_SECONDS = 3;

/** What the page shows. A new object whenever anything changed. */
export interface SessionView {
  current: Query | null;
  upcoming: readonly Query[];
  last: Answered | null;
  /** the answer just given, while its pair is still on screen */
  flash: Answer | null;
  /** why there is no pair; null before the first answer of the server */
  reason: Queries["reason"] | null;
  /** why the server gives none: it is unreachable, or refuses */
  trouble: string | null;
  /** a quiet word about something that happened */
  notice: string | null;
  /** labels given in this tab, skips not counted */
  labelled: number;
  /** grows with every pair put on screen, an undone one too */
  shown: number;
}

interface Parts {
  experimentId: string;
  server: LabellingServer;
  outbox: Outbox;
  storage: MemoryStorage;
  storageKey: string;
}

/** One person labelling one experiment: which pair is on screen, what was said, what comes next. */
export class LabellingSession {
  readonly #parts: Parts;
  readonly #leases: Leases;
  readonly #watchers = new Set<() => void>();
  readonly #unlisten: () => void;
  /** answered here and not undone; the server may go on offering them for a moment */
  readonly #settled = new Set<string>();
  #queue: Queue;
  #view: SessionView;
  #asking = false;
  #disposed = false;
  #pollTimer: ReturnType<typeof setTimeout> | undefined;
  #flashTimer: ReturnType<typeof setTimeout> | undefined;

  constructor(parts: Parts) {
    this.#parts = parts;
    const { labelled, past } = recall(parts.storage, parts.storageKey);
    this.#queue = { ...EMPTY, past };
    this.#view = {
      ...{ current: null, upcoming: [], last: past.at(-1) ?? null, flash: null },
      ...{ reason: null, trouble: null, notice: null, labelled, shown: 0 },
    };
    this.#unlisten = parts.outbox.listen((outcome) => this.#delivered(outcome));
    this.#leases = new Leases({
      held: () => this.#queue.pairs.filter(({ id }) => !this.#isBeingSettled(id)),
      heartbeat: (id) => parts.server.heartbeat(id),
      lost: (id) => {
        // A heartbeat that crossed the label on its way finds the query closed: by us.
        if (this.#isBeingSettled(id)) return;
        this.#lose(id, "That pair went to someone else, since it was open for long.");
      },
    });
    void this.#refill();
  }

  readonly view = (): SessionView => this.#view;

  readonly watch = (watcher: () => void): (() => void) => {
    this.#watchers.add(watcher);
    return () => this.#watchers.delete(watcher);
  };

  /** Says which is better of the pair on screen. Kept at once; the next pair follows when the eye has seen it. */
  answer(answer: Answer, responseSeconds: number): void {
    const query = this.#view.current;
    if (!query || this.#view.flash) return;
    this.#leases.seen();
    const body = {
      label: LABEL_OF[answer],
      order: "shown" as const,
      response_seconds: Math.min(86_400, Math.max(0, responseSeconds)),
    };
    this.#settled.add(query.id);
    const { experimentId, outbox } = this.#parts;
    outbox.put({ kind: "label", experimentId, queryId: query.id, body });
    this.#publish({ flash: answer, notice: null });
    this.#flashTimer = setTimeout(() => this.#advance(answer), FLASH_SECONDS * 1000);
  }

  /** Brings the pair answered last back on screen and takes its label away. */
  undo(): void {
    this.#leases.seen();
    if (this.#view.flash) {
      clearTimeout(this.#flashTimer);
      this.#advance(this.#view.flash);
    }
    const last = this.#queue.past.at(-1);
    if (!last) {
      this.#publish({ notice: "There is nothing to undo." });
      return;
    }
    const { id } = last.query;
    const { experimentId, outbox } = this.#parts;
    if (!outbox.takeBack(id)) outbox.put({ kind: "undo", experimentId, queryId: id });
    this.#settled.delete(id);
    this.#queue = undone(this.#queue);
    this.#show({ notice: "Undone: this pair again.", labelled: this.#view.labelled - countOf(last.answer) });
  }

  /** The person moved the mouse or pressed a key: they are here. */
  seen(): void {
    this.#leases.seen();
  }

  /** Something changed at the server, or the person is back: ask without waiting for the next poll. */
  wake(): void {
    this.#leases.seen();
    void this.#refill();
  }

  /** Leaves: the pairs go back to the others. Labels on their way go on being sent by the outbox. */
  dispose(): void {
    this.#disposed = true;
    clearTimeout(this.#pollTimer);
    clearTimeout(this.#flashTimer);
    this.#unlisten();
    this.#leases.stop();
    const ours = this.#queue.pairs.filter(({ id }) => !this.#settled.has(id));
    for (const { id } of ours) this.#parts.server.release(id);
  }

  /** Answered here, or a label or undo of it on its way: its lease is no longer ours to keep. */
  #isBeingSettled(id: string): boolean {
    return this.#settled.has(id) || this.#parts.outbox.holds(id);
  }

  #advance(answer: Answer): void {
    this.#queue = answered(this.#queue, answer);
    this.#show({ flash: null, labelled: this.#view.labelled + countOf(answer) });
    void this.#refill();
  }

  #delivered({ operation, refused }: Outcome): void {
    if (refused === null) return;
    const { queryId, kind } = operation;
    const answeredHere = this.#queue.past.find(({ query }) => query.id === queryId);
    const what = kind === "label" ? "A label was not taken" : "That could not be undone";
    if (kind === "label" && answeredHere)
      this.#publish({ labelled: this.#view.labelled - countOf(answeredHere.answer) });
    this.#settled.delete(queryId);
    this.#lose(queryId, `${what}: ${sentenceOf(refused)}`);
  }

  #lose(id: string, notice: string): void {
    const onScreen = this.#view.current?.id === id;
    const known = onScreen || this.#queue.past.some(({ query }) => query.id === id);
    this.#queue = dropped(this.#queue, id);
    if (onScreen) clearTimeout(this.#flashTimer);
    this.#show(onScreen ? { flash: null, notice } : known ? { notice } : {});
    void this.#refill();
  }

  /** Keeps three pairs at hand: asks for what is missing, and again later when the server has none. */
  async #refill(): Promise<void> {
    if (this.#asking || this.#disposed || this.#queue.pairs.length >= WANTED) return;
    clearTimeout(this.#pollTimer);
    this.#asking = true;
    try {
      const unsent = this.#parts.outbox.labelled();
      const { items, reason } = await this.#parts.server.next(Math.min(MOST, WANTED + unsent.size));
      if (this.#disposed) {
        for (const { id } of items) this.#parts.server.release(id);
        return;
      }
      this.#queue = offered(this.#queue, items, new Set([...this.#settled, ...unsent]));
      this.#show({ reason, trouble: null });
    } catch (error) {
      this.#publish({ trouble: sentenceOf(error), reason: isPassing(error) ? this.#view.reason : "" });
    } finally {
      this.#asking = false;
    }
    const wait = this.#queue.pairs.length === 0 ? POLL_EMPTY_SECONDS : POLL_SECONDS;
    if (!this.#disposed) this.#pollTimer = setTimeout(() => void this.#refill(), wait * 1000);
  }

  #show(change: Partial<SessionView>): void {
    const current = this.#queue.pairs[0] ?? null;
    const moved = current !== null && current.id !== this.#view.current?.id;
    const last = this.#queue.past.at(-1) ?? null;
    const upcoming = this.#queue.pairs.slice(1);
    this.#publish({ ...change, current, upcoming, last, shown: this.#view.shown + (moved ? 1 : 0) });
    const { storage, storageKey } = this.#parts;
    remember(storage, storageKey, { labelled: this.#view.labelled, past: this.#queue.past });
  }

  #publish(change: Partial<SessionView>): void {
    this.#view = { ...this.#view, ...change };
    for (const watcher of this.#watchers) watcher();
  }
}

function countOf(answer: Answer): number {
  return answer === "skip" ? 0 : 1;
}
