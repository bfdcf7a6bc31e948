import type { Query } from "@/shared/api/types";
import type { Answer } from "./answers";

/** Pairs answered in this tab that can still be brought back, the newest last. */
const PAST_KEPT = 20;

export interface Answered {
  query: Query;
  answer: Answer;
}

/** The pairs of one labelling session: the first of `pairs` is on screen. Never changed in place. */
export interface Queue {
  readonly pairs: readonly Query[];
  readonly past: readonly Answered[];
}

export const EMPTY: Queue = { pairs: [], past: [] };

/**
 * Takes in pairs that the server leased to us.
 *
 * The order on screen stays; `settled` are answered here already, though perhaps not yet at the server, which
 * therefore still offers them.
 */
export function offered(queue: Queue, items: readonly Query[], settled: ReadonlySet<string>): Queue {
  const known = new Set(queue.pairs.map(({ id }) => id));
  const fresh = items.filter(({ id }) => !known.has(id) && !settled.has(id));
  return { ...queue, pairs: [...queue.pairs, ...fresh] };
}

/** The pair on screen is answered and leaves. */
export function answered(queue: Queue, answer: Answer): Queue {
  const [query, ...pairs] = queue.pairs;
  if (!query) return queue;
  return { pairs, past: [...queue.past, { query, answer }].slice(-PAST_KEPT) };
}

/** The pair answered last is on screen again, with the sides it had. */
export function undone(queue: Queue): Queue {
  const last = queue.past.at(-1);
  if (!last) return queue;
  return { pairs: [last.query, ...queue.pairs], past: queue.past.slice(0, -1) };
}

/** A pair that is no longer ours goes, wherever it is. */
export function dropped(queue: Queue, id: string): Queue {
  return {
    pairs: queue.pairs.filter((query) => query.id !== id),
    past: queue.past.filter(({ query }) => query.id !== id),
  };
}
