import type { NewLabel } from "@/shared/api/types";

/** A label or an undo that the server has not acknowledged yet. */
export type Operation = NewOperation & { id: string };

export type NewOperation =
  | { kind: "label"; experimentId: string; queryId: string; body: NewLabel }
  /** `replaces`: revision of the label to undo, 0 if it is not known yet; `tab`: gets the lease of the query */
  | { kind: "undo"; experimentId: string; queryId: string; replaces?: number; tab?: string };

/** The operation, with the revision of the label that it changes or undoes. */
export function replacing(operation: Operation, revision: number): Operation {
  return operation.kind === "undo"
    ? { ...operation, replaces: revision }
    : { ...operation, body: { ...operation.body, replaces: revision } };
}

/** The methods of localStorage that are used. */
export interface Storage {
  readonly length: number;
  key(index: number): string | null;
  getItem(key: string): string | null;
  setItem(key: string, value: string): void;
  removeItem(key: string): void;
}

const PREFIX = "accord.unsent.";

/** How many labels of any user wait in the browser's storage, for example while nobody is signed in. */
export function countStoredLabels(storage: Storage): number {
  try {
    const keys = Array.from({ length: storage.length }, (_, index) => storage.key(index) ?? "");
    const operations = keys
      .filter((key) => key.startsWith(PREFIX))
      .flatMap((key) => parse(storage.getItem(key)));
    return operations.filter(({ kind }) => kind === "label").length;
  } catch (error) {
    warn(error);
    return 0;
  }
}

/**
 * One user's unsent operations in the browser's storage. Each has its own key, so that two tabs do not overwrite each
 * other's.
 *
 * When storage is full or not permitted, operations are kept only in memory and a warning is logged.
 */
export class OperationStore {
  readonly #prefix: string;
  readonly #storage: Storage;
  /** ids of the operations that were written to the storage or read from it */
  readonly #stored = new Set<string>();
  #count = 0;

  constructor(userId: string, storage: Storage) {
    this.#prefix = `${PREFIX}${userId}.`;
    this.#storage = storage;
  }

  /** Creates an id. Ids sort by creation time. */
  newId(): string {
    const time = Date.now().toString(36).padStart(10, "0");
    const count = (this.#count++).toString(36).padStart(6, "0");
    return `${time}-${count}-${Math.random().toString(36).slice(2, 8)}`;
  }

  /** The stored operations, oldest first. */
  load(): Operation[] {
    try {
      const keys = Array.from({ length: this.#storage.length }, (_, index) => this.#storage.key(index) ?? "");
      const ownKeys = keys.filter((key) => key.startsWith(this.#prefix)).sort();
      const operations = ownKeys.flatMap((key) => parse(this.#storage.getItem(key)));
      for (const { id } of operations) this.#stored.add(id);
      return operations;
    } catch (error) {
      warn(error);
      return [];
    }
  }

  save(operation: Operation): void {
    try {
      this.#storage.setItem(this.#prefix + operation.id, JSON.stringify(operation));
      this.#stored.add(operation.id);
    } catch (error) {
      warn(error);
    }
  }

  /** Whether an operation that was stored is no longer there: another tab has removed it. */
  isRemoved(id: string): boolean {
    try {
      return this.#stored.has(id) && this.#storage.getItem(this.#prefix + id) === null;
    } catch (error) {
      warn(error);
      return false;
    }
  }

  remove(id: string): void {
    try {
      this.#storage.removeItem(this.#prefix + id);
    } catch (error) {
      warn(error);
    }
  }
}

function warn(error: unknown): void {
  console.warn("Browser storage is unavailable: unsent labels will not survive a reload.", error);
}

/** An empty list for an entry that is not valid JSON: the browser crashed while writing it. */
function parse(text: string | null): Operation[] {
  if (text === null) return [];
  try {
    return [JSON.parse(text) as Operation];
  } catch {
    return [];
  }
}
