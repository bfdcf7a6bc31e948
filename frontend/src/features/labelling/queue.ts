import type { Query } from "@/shared/api/types";
import type { Choice } from "./choices";

/** How many labels of this tab can be undone. */
const MAX_UNDO = 20;

export interface LabelledPair {
  query: Query;
  choice: Choice;
}

/** The pairs of one labelling session; the first of `pairs` is on screen. Immutable. */
export interface Queue {
  readonly pairs: readonly Query[];
  /** newest last */
  readonly past: readonly LabelledPair[];
}

export const EMPTY: Queue = { pairs: [], past: [] };

/**
 * Appends leased pairs that are not in the queue yet.
 *
 * @param labelled queries labelled in this browser. The server offers them until it has received the label.
 */
export function append(queue: Queue, queries: readonly Query[], labelled: ReadonlySet<string>): Queue {
  const known = new Set(queue.pairs.map(({ id }) => id));
  const added = queries.filter(({ id }) => !known.has(id) && !labelled.has(id));
  return { ...queue, pairs: [...queue.pairs, ...added] };
}

/** Moves the pair on screen to the past. */
export function labelFirst(queue: Queue, choice: Choice): Queue {
  const [query, ...pairs] = queue.pairs;
  if (!query) return queue;
  return { pairs, past: [...queue.past, { query, choice }].slice(-MAX_UNDO) };
}

/** Brings the last labelled pair back on screen. */
export function undoLast(queue: Queue): Queue {
  const last = queue.past.at(-1);
  if (!last) return queue;
  return { pairs: [last.query, ...queue.pairs], past: queue.past.slice(0, -1) };
}

/** Removes a pair from the queue and from the past. */
export function remove(queue: Queue, id: string): Queue {
  return {
    pairs: queue.pairs.filter((query) => query.id !== id),
    past: queue.past.filter(({ query }) => query.id !== id),
  };
}
