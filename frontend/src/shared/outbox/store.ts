import type { Operation } from "./outbox";

/** The part of localStorage that is used. */
export interface Storage {
  readonly length: number;
  key(index: number): string | null;
  getItem(key: string): string | null;
  setItem(key: string, value: string): void;
  removeItem(key: string): void;
}

/**
 * Operations of one user in the browser's storage: one key each, so that two tabs never overwrite each other's.
 *
 * A browser without room or permission for storage keeps them in memory alone: labelling goes on.
 */
export class OperationStore {
  readonly #prefix: string;
  readonly #storage: Storage;
  #made = 0;

  constructor(userId: string, storage: Storage) {
    this.#prefix = `accord.unsent.${userId}.`;
    this.#storage = storage;
  }

  /** Ids sort by the time they were made. */
  newId(): string {
    const time = Date.now().toString(36).padStart(10, "0");
    const count = (this.#made++).toString(36).padStart(6, "0");
    return `${time}-${count}-${Math.random().toString(36).slice(2, 8)}`;
  }

  load(): Operation[] {
    try {
      const keys = Array.from({ length: this.#storage.length }, (_, index) => this.#storage.key(index) ?? "");
      const mine = keys.filter((key) => key.startsWith(this.#prefix)).sort();
      return mine.flatMap((key) => read(this.#storage.getItem(key)));
    } catch (error) {
      return this.#unavailable(error, []);
    }
  }

  save(operation: Operation): void {
    try {
      this.#storage.setItem(this.#prefix + operation.id, JSON.stringify(operation));
    } catch (error) {
      this.#unavailable(error, undefined);
    }
  }

  remove(id: string): void {
    try {
      this.#storage.removeItem(this.#prefix + id);
    } catch (error) {
      this.#unavailable(error, undefined);
    }
  }

  #unavailable<Value>(error: unknown, value: Value): Value {
    console.warn("This browser stores nothing: unsent labels would not survive a reload.", error);
    return value;
  }
}

function read(text: string | null): Operation[] {
  if (text === null) return [];
  try {
    return [JSON.parse(text) as Operation];
  } catch {
    return []; // half-written by a browser that died: there is nothing in it to send
  }
}
